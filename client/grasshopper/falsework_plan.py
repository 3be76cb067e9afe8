#! python 3
"""Plan: a Grasshopper script component that says in which order blocks are assembled, and what is held.

Inputs:
    blocks: list; closed meshes, Breps, extrusions, boxes or SubDs.
    supports: list; the same for what is fixed for ever.
    robots: item, integer; blocks that can be held at a time, 2 without it.
    step: item, integer; the step that is shown, 0 for the beginning, the end without it.
    friction: item, number; coefficient of friction of every contact.
    density: item, number; kg/m3.
    draw: item, Boolean; whether to make the picture, which takes seconds.
    run: item, Boolean; nothing is computed without it.

Outputs:
    outcome: text; found, or why there is no plan.
    steps: text, a line a step.
    placed: blocks that stand by themselves after the step, and the supports.
    held: blocks that are held after the step.
    picture: path of a PNG, of the step, or of the whole plan if no step is given.
"""

import Grasshopper
import Rhino

from falsework_client import ClientError
from falsework_client.grasshopper import assemble
from falsework_client.rhino import unit_of

outcome, steps, placed, held, picture = "set run to True", [], [], [], None
if run:
    try:
        found = assemble(
            blocks,
            supports,
            unit=unit_of(Rhino.RhinoDoc.ActiveDoc),
            robots=robots,
            step=step,
            friction=friction,
            density=density,
            draw=bool(draw),
        )
        outcome, steps, placed, held, picture = found.outcome, found.steps, found.placed, found.held, found.picture
    except ClientError as error:
        outcome = str(error)
        ghenv.Component.AddRuntimeMessage(Grasshopper.Kernel.GH_RuntimeMessageLevel.Error, outcome)
