"""Cell files for tests that change them."""

ONE_ARM = """
format = "falsework.cell/1"
name = "one arm"

[structure]
position = [0.9, 0.0, 0.0]
scale = 0.5

[margins]
free = 0.004

[grippers.cup]
kind = "suction"
payload = 5.0
mass = 1.0
cup = 0.02
tool = { position = [0.0, 0.0, 0.1], rpy = [0, 0, 90] }
shapes = [{ cylinder = { radius = 0.03, low = 0.0, high = 0.099 } }]

[[robots]]
name = "arm"
model = "irb2600-12/1.65"
gripper = "cup"
base = { position = [0.0, 0.0, 0.0], yaw = 90 }
home = [0, -40, 30, 0, 60, 0]
places = [{ position = [0.1, -0.9, 0.5] }]

[[obstacles]]
name = "table"
box = { low = [-0.3, -0.3, 0.0], high = [0.3, 0.3, 0.4] }
position = [2.0, 0.0, 0.0]
"""

TWO_JOINTS = """
format = "falsework.cell/1"
name = "cell"
[grippers.cup]
kind = "suction"
payload = 5.0
cup = 0.02
tool = { position = [0.0, 0.0, 0.1] }
shapes = [{ cylinder = { radius = 0.03, low = 0.0, high = 0.099 } }]
[[robots]]
name = "arm"
model = "arm.urdf"
gripper = "cup"
base = { position = [0.0, 0.0, 0.2] }
"""
"""One arm of the description in `arm_description`."""

REACHING = """
format = "falsework.cell/1"
name = "one arm"

[structure]
density = 200

[grippers.cup]
kind = "suction"
payload = 10.0
mass = 1.0
cup = 0.02
tool = { position = [0.0, 0.0, 0.18] }
shapes = [
    { cylinder = { radius = 0.045, low = 0.0, high = 0.1 } },
    { cylinder = { radius = 0.02, low = 0.1, high = 0.178 } },
]

[[robots]]
name = "arm"
model = "irb2600-12/1.65"
gripper = "cup"
base = { position = [-1.15, 0.0, 0.0], yaw = 0.0 }
places = [{ position = [0.15, -0.95, 0.55] }]
"""
