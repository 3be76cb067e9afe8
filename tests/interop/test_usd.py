"""USD: valid by the validators that come with it, with masses, friction and motion that a simulator can use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, Plan, export, load_structure
from falsework.interop.usd import to_usd

pytest.importorskip("pxr", reason="needs usd-core, of the dependency group test")

# Its modules are filled in by compiled code, of which a type checker knows nothing.
Gf: Any = import_module("pxr.Gf")
Usd: Any = import_module("pxr.Usd")
UsdGeom: Any = import_module("pxr.UsdGeom")
UsdPhysics: Any = import_module("pxr.UsdPhysics")
UsdShade: Any = import_module("pxr.UsdShade")
UsdValidation: Any = import_module("pxr.UsdValidation")


def opened(text: str, folder: Path) -> Any:
    """The stage in a text."""
    path = folder / f"stage-{len(list(folder.iterdir()))}.usda"  # opened by name once, a stage is kept
    path.write_text(text, encoding="utf-8")
    return Usd.Stage.Open(str(path))


def parts_of(stage: Any) -> list[Any]:
    """Prims of the parts, by number."""
    prims = [prim for prim in stage.Traverse() if prim.HasAttribute("falsework:part")]
    return sorted(prims, key=lambda prim: prim.GetAttribute("falsework:part").Get())


@pytest.mark.parametrize("spec", ["arch:blocks=7", "bottle"])
def test_bodies_weigh_what_the_parts_do(spec: str, tmp_path: Path) -> None:
    assembly = load_structure(spec)
    stage = opened(to_usd(assembly), tmp_path)
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == UsdPhysics.GetStageKilogramsPerUnit(stage) == 1
    for part, prim in enumerate(parts_of(stage)):
        assert prim.GetDisplayName() == assembly.names[part]
        assert prim.HasAPI(UsdPhysics.RigidBodyAPI) != assembly.boundary[part]
        place = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0)
        surface = UsdGeom.Mesh(prim.GetChild("surface"))
        points = np.array([place.Transform(Gf.Vec3d(point)) for point in surface.GetPointsAttr().Get()])
        assert np.allclose(points, assembly.meshes[part].vertices, atol=1e-5)
        faces = np.array(surface.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        assert np.array_equal(faces, assembly.meshes[part].faces)
        material, _ = UsdShade.MaterialBindingAPI(surface.GetPrim()).ComputeBoundMaterial("physics")
        assert UsdPhysics.MaterialAPI(material).GetStaticFrictionAttr().Get() == pytest.approx(assembly.friction)
        if assembly.boundary[part]:
            continue
        body = UsdPhysics.MassAPI(prim)
        assert body.GetMassAttr().Get() == pytest.approx(assembly.mass.mass[part], rel=1e-6)
        turn = np.array(Gf.Matrix3d(Gf.Rotation(Gf.Quatd(body.GetPrincipalAxesAttr().Get()))))  # rows are the axes
        inertia = turn.T @ np.diag(body.GetDiagonalInertiaAttr().Get()) @ turn
        assert np.allclose(inertia, assembly.mass.inertia[part], rtol=1e-4, atol=1e-5 * inertia.max())


def test_only_convex_parts_collide_as_their_hulls(tmp_path: Path) -> None:
    for spec, wanted in (("arch:blocks=7", "convexHull"), ("bottle", "convexDecomposition")):
        stage = opened(to_usd(load_structure(spec)), tmp_path)
        shapes = {prim.GetChild("surface").GetAttribute("physics:approximation").Get() for prim in parts_of(stage)}
        assert wanted in shapes


def test_a_plan_moves_and_the_validators_have_nothing_to_say(arch: Assembly, plan: Plan, tmp_path: Path) -> None:
    stage = opened(to_usd(arch, plan, step_seconds=2.0), tmp_path)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert [error.GetMessage() for error in UsdValidation.ValidationContext(validators).Validate(stage)] == []
    rate = stage.GetTimeCodesPerSecond()
    assert stage.GetEndTimeCode() == 2.0 * len(plan) * rate
    prims = parts_of(stage)
    for step in range(1, len(plan) + 1):
        time = (2.0 * step - 0.01) * rate
        for part, prim in enumerate(prims):
            seen = UsdGeom.Imageable(prim).ComputeVisibility(time) != "invisible"
            assert seen == (plan.states[step, part] != 0)
            if seen:
                place = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(time).ExtractTranslation()
                assert np.allclose(place, arch.mass.center[part], atol=1e-5)


def test_gravity_is_that_of_the_plan(arch: Assembly, plan: Plan, tmp_path: Path) -> None:
    for given, gravity in ((None, 9.81), (replace(plan, claim=replace(plan.claim, gravity=1.62)), 1.62)):
        stage = opened(to_usd(arch, given), tmp_path)
        (scene,) = (prim for prim in stage.Traverse() if prim.IsA(UsdPhysics.Scene))
        assert UsdPhysics.Scene(scene).GetGravityMagnitudeAttr().Get() == pytest.approx(gravity)


def test_presses_are_attributes_of_the_part(
    arch: Assembly, plan: Plan, press_once: Callable[..., tuple[Plan, int, int]], tmp_path: Path
) -> None:
    pressed, step, part = press_once(plan, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    stage = opened(to_usd(arch, pressed), tmp_path)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert [error.GetMessage() for error in UsdValidation.ValidationContext(validators).Validate(stage)] == []
    for number, prim in enumerate(parts_of(stage)):
        found = {name: prim.GetAttribute(f"falsework:press{name}").Get() for name in ("Steps", "Forces", "Moments")}
        if number == part:
            assert list(found["Steps"]) == [step]
            assert [tuple(value) for value in found["Forces"]] == [(1.0, 2.0, 3.0)]
            assert [tuple(value) for value in found["Moments"]] == [(4.0, 5.0, 6.0)]
        else:
            assert set(found.values()) == {None}


def test_names_that_usd_does_not_allow(tmp_path: Path) -> None:
    from falsework.geometry import TriangleMesh

    arch = load_structure("arch:blocks=3")
    names = ('key "stone"\n', "surface", "3", "schlußstein", "physics")
    meshes = [
        TriangleMesh.from_arrays(name, mesh.vertices, mesh.faces) for name, mesh in zip(names, arch.meshes, strict=True)
    ]
    export(Assembly.from_meshes(meshes, boundary=arch.boundary, name="7 days"), tmp_path / "out.usda")
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    prims = parts_of(stage)
    assert [prim.GetDisplayName() for prim in prims] == ['key "stone"', "surface", "3", "schlußstein", "physics"]
    assert len({prim.GetPath() for prim in prims}) == 5
