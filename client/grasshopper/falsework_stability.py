#! python 3
"""Stability: a Grasshopper script component that says whether blocks stand.

Inputs:
    blocks: list; closed meshes, Breps, extrusions, boxes or SubDs.
    supports: list; the same for what is fixed for ever.
    friction: item, number; coefficient of friction of every contact.
    density: item, number; kg/m3.
    draw: item, Boolean; whether to make the picture, which takes seconds.
    run: item, Boolean; nothing is computed without it.

Outputs:
    stable: Boolean.
    verdict: text.
    moving: the blocks that move, the fastest first.
    picture: path of a PNG.
"""

import Grasshopper
import Rhino

from falsework_client import ClientError
from falsework_client.grasshopper import judge
from falsework_client.rhino import unit_of

stable, verdict, moving, picture = None, "set run to True", [], None
if run:
    try:
        unit = unit_of(Rhino.RhinoDoc.ActiveDoc)
        found = judge(blocks, supports, unit=unit, friction=friction, density=density, draw=bool(draw))
        stable, verdict, moving, picture = found.stable, found.verdict, found.moving, found.picture
    except ClientError as error:
        verdict = str(error)
        ghenv.Component.AddRuntimeMessage(Grasshopper.Kernel.GH_RuntimeMessageLevel.Error, verdict)
