"""URDF of an arm of two joints, for tests that change it."""

from __future__ import annotations

from pathlib import Path

from falsework.robots import RobotModel, load_urdf


def urdf_text() -> str:
    """Return a turning and a sliding joint with shapes on all links, and the frame of the tool."""
    return """<robot name="two">
<link name="base"><collision><origin xyz="0 0 -0.1"/><geometry><box size="0.2 0.2 0.1"/></geometry></collision></link>
<link name="one"><collision><origin xyz="0 0 0.2"/><geometry><box size="0.1 0.1 0.3"/></geometry></collision></link>
<link name="two"><collision><geometry><sphere radius="0.05"/></geometry></collision></link>
<link name="tool0"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="one"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" velocity="2"/></joint>
<joint name="slide" type="prismatic"><parent link="one"/><child link="two"/><origin xyz="0 0 0.4"/>
<axis xyz="0 0 1"/><limit lower="0" upper="0.3" velocity="1"/></joint>
<joint name="mount" type="fixed"><parent link="two"/><child link="tool0"/><origin xyz="0 0 0.05"/></joint>
</robot>"""


def arm_model(file: Path) -> RobotModel:
    """Write the description into a file, and read it."""
    file.write_text(urdf_text())
    return load_urdf(file)
