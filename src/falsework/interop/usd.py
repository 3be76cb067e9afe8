"""USD export with physics: bodies, masses, friction and supports, and a plan as time samples.

Written as text (`.usda`), which needs no package and shows in a difference what changed; `usdcat` makes it binary. Why
USD and not URDF: docs/decisions/files-and-formats.md.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from falsework import __version__
from falsework.interop.tracks import Track, Tracks, tracks_of
from falsework.robots.model.shapes import principal_axes, wxyz_of
from falsework.search.plans.steps import NO_ROBOT
from falsework.stability.settings import StabilitySettings
from falsework.utils.files.formats import Exporter, writer_of
from falsework.viewer.palette import BOUNDARY, INSTALLED, robot_color, unit_rgb

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.geometry.mesh.mesh import TriangleMesh
    from falsework.search.plans.plan import Plan

FRAMES = 24
"""Time codes a second."""
_CONVEX = 1e-3
"""Share of the convex hull's volume that may be missing in a part that counts as convex."""


def to_usd(assembly: Assembly, plan: Plan | None = None, *, step_seconds: float = 1.0) -> str:
    """Return a structure as a USD stage in text form, in metres, kilograms and z up.

    Every part is an `Xform` at its centre of mass with mass, inertia and a collision mesh; boundary parts are fixed
    colliders, the others rigid bodies. One physics material carries the friction. With a plan, parts follow it as
    kinematic bodies, appear and disappear, and take the colour of the robot that holds them. Custom attributes of a
    part give the presses on it: steps, forces in N and moments in N m about its centre of mass.
    """
    times = None if plan is None else tracks_of(plan, assembly, step_seconds)
    names = _identifiers((assembly.name, *assembly.names))
    root, parts = names[0], names[1:]
    lines = [*_header(root, times), "", f'def Xform "{root}" (kind = "assembly")', "{"]
    lines += _indent([f"custom string falsework:identity = {_text(assembly.identity)}", ""])
    lines += _indent(_scene(StabilitySettings().gravity if plan is None else plan.claim.gravity))
    lines += _indent(_material(assembly.friction))
    for part, name in enumerate(parts):
        track = None if times is None else times.tracks[part]
        presses = [] if plan is None else _presses(plan, part)
        lines += _indent(_body(assembly, part, name, root, track, presses))
    return "\n".join([*lines, "}", ""])


def _header(root: str, times: Tracks | None) -> list[str]:
    entries = [
        f'doc = "falsework {__version__}"',
        f'defaultPrim = "{root}"',
        "kilogramsPerUnit = 1",
        "metersPerUnit = 1",
        'upAxis = "Z"',
    ]
    if times is not None:
        entries += ["startTimeCode = 0", f"endTimeCode = {_number(times.seconds * FRAMES)}"]
        entries += [f"framesPerSecond = {FRAMES}", f"timeCodesPerSecond = {FRAMES}"]
    return ["#usda 1.0", "(", *_indent(entries), ")"]


def _scene(gravity: float) -> list[str]:
    return [
        'def PhysicsScene "physics"',
        "{",
        "    vector3f physics:gravityDirection = (0, 0, -1)",
        f"    float physics:gravityMagnitude = {_number(gravity)}",
        "}",
        "",
    ]


def _material(friction: float) -> list[str]:
    value = _number(friction)
    return [
        'def Material "surface" (prepend apiSchemas = ["PhysicsMaterialAPI"])',
        "{",
        f"    float physics:dynamicFriction = {value}",
        f"    float physics:staticFriction = {value}",
        "    float physics:restitution = 0",
        "}",
        "",
    ]


def _presses(plan: Plan, part: int) -> list[str]:
    """Return the attributes of the presses on a part; none if no robot presses it."""
    mine = [(step, press) for step, some in enumerate(plan.presses, 1) for press in some if press.part == part]
    if not mine:
        return []
    lines = [f"    custom int[] falsework:pressSteps = [{', '.join(str(step) for step, _ in mine)}]"]
    for name, rows in (("Forces", slice(3)), ("Moments", slice(3, 6))):
        values = ", ".join(_tuple(press.wrench[rows]) for _, press in mine)
        lines.append(f"    custom double3[] falsework:press{name} = [{values}]")
    return lines


def _body(
    assembly: Assembly, part: int, name: str, root: str, track: Track | None, presses: Sequence[str] = ()
) -> list[str]:
    """Return one part: its pose, mass, presses and surface."""
    fixed = bool(assembly.boundary[part])
    schemas = "" if fixed else '    prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]\n'
    center = assembly.mass.center[part]
    lines = [
        f'def Xform "{name}" (\n    displayName = {_text(assembly.names[part])}\n    kind = "component"\n{schemas})',
        "{",
        f"    custom int falsework:part = {part}",
        *presses,
    ]
    if not fixed:
        moments, axes = principal_axes(assembly.mass.inertia[part])
        lines += [
            f"    float physics:mass = {_number(assembly.mass.mass[part])}",
            "    point3f physics:centerOfMass = (0, 0, 0)",
            f"    float3 physics:diagonalInertia = {_tuple(moments)}",
            f"    quatf physics:principalAxes = {_tuple(wxyz_of(axes))}",
        ]
        if track is not None:
            lines.append("    bool physics:kinematicEnabled = 1")
    lines.append(f"    double3 xformOp:translate = {_tuple(center)}")
    if track is not None and track.path:
        lines += _samples("double3 xformOp:translate", ((time, _tuple(center + step)) for time, step in track.path))
    lines.append('    uniform token[] xformOpOrder = ["xformOp:translate"]')
    if track is not None and track.appears:
        seen = ((time, '"inherited"' if shown else '"invisible"') for time, shown in track.shown)
        lines += _samples("token visibility", seen)
    return [*lines, "", *_indent(_surface(assembly, part, root, track)), "}", ""]


def _surface(assembly: Assembly, part: int, root: str, track: Track | None) -> list[str]:
    mesh = assembly.meshes[part]
    points = mesh.vertices - assembly.mass.center[part]
    color = BOUNDARY if assembly.boundary[part] else INSTALLED
    schemas = '"PhysicsCollisionAPI", "PhysicsMeshCollisionAPI", "MaterialBindingAPI"'
    lines = [
        f'def Mesh "surface" (prepend apiSchemas = [{schemas}])',
        "{",
        f"    float3[] extent = [{_tuple(points.min(axis=0))}, {_tuple(points.max(axis=0))}]",
        f"    int[] faceVertexCounts = [{', '.join('3' * len(mesh.faces))}]",
        f"    int[] faceVertexIndices = [{', '.join(map(str, mesh.faces.ravel().tolist()))}]",
        f"    point3f[] points = [{', '.join(map(_tuple, points))}]",
        f'    uniform token physics:approximation = "{"convexHull" if _convex(mesh) else "convexDecomposition"}"',
        f"    rel material:binding:physics = </{root}/surface>",
        f"    color3f[] primvars:displayColor = [{_tuple(unit_rgb(color))}]",
    ]
    if track is not None and track.is_held:
        lines += _samples("color3f[] primvars:displayColor", _colors(track))
    return [*lines, '    uniform token subdivisionScheme = "none"', "}"]


def _colors(track: Track) -> Iterable[tuple[float, str]]:
    """Yield the colour by the holder of the part; a key just before each change keeps it from fading."""
    before = None
    for time, robot in track.holder:
        value = f"[{_tuple(unit_rgb(INSTALLED if robot == NO_ROBOT else robot_color(robot)))}]"
        if before is not None:
            yield time - 0.01, before
        yield time, value
        before = value


def _samples(attribute: str, keys: Iterable[tuple[float, str]]) -> list[str]:
    rows = [f"        {_number(time * FRAMES)}: {value}," for time, value in keys]
    return [f"    {attribute}.timeSamples = {{", *rows, "    }"]


def _convex(mesh: TriangleMesh) -> bool:
    from scipy.spatial import ConvexHull

    return bool(mesh.volume > (1 - _CONVEX) * ConvexHull(mesh.vertices).volume)


def _identifiers(names: Sequence[str]) -> list[str]:
    """Return names as USD allows them, each once and none like the prims beside the parts."""
    taken, found = {"physics", "surface"}, []
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9_]", "_", name) or "part"
        plain = f"part_{plain}" if plain[0].isdigit() else plain
        number, free = 1, plain
        while free in taken:
            number += 1
            free = f"{plain}_{number}"
        taken.add(free)
        found.append(free)
    return found


def _indent(lines: Iterable[str]) -> list[str]:
    return ["\n".join(f"    {row}" if row else "" for row in line.split("\n")) for line in lines]


def _text(text: str) -> str:
    """Return a text in quotes; JSON's escapes are a part of USD's."""
    return json.dumps("".join(letter for letter in text if letter.isprintable()), ensure_ascii=False)


def _tuple(values: Iterable[Any]) -> str:
    return f"({', '.join(map(_number, values))})"


def _number(value: float) -> str:
    return f"{float(value):.9g}"


EXPORTER = Exporter(writer_of(to_usd), (".usd", ".usda"), ("Assembly", "Plan"), ("step_seconds",))
