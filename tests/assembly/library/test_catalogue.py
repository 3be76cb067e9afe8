"""Names and parameters: what is understood, and what is said where something is not."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from falsework.assembly.library import arch, build, is_built_in, structures
from falsework.errors import AssemblyError, InputError


def test_catalogue_is_complete_and_plain_data() -> None:
    names = [entry.name for entry in structures()]
    assert names == [
        "arch",
        "catenary",
        "dome",
        "vault",
        "wall",
        "stack",
        "corbel",
        "bottle",
        "polycube",
        "house",
        "shelf",
    ]
    for entry in structures():
        assert entry.description.endswith(".")
        assert entry.description in (entry.__doc__ or "")
        assert list(entry.parameters) == [parameter.name for parameter in entry.details]
        json.dumps(entry.parameters)
        for parameter in entry.details:
            assert parameter.minimum <= parameter.default <= parameter.maximum
            assert type(parameter.default) is parameter.kind
            assert parameter.meaning
            assert f"{parameter.name}: " in (entry.__doc__ or "")


def test_text_and_python_make_the_same() -> None:
    text = build("arch:blocks=7, thickness=0.3")
    assert text.name == "arch:blocks=7,thickness=0.3"
    assert text.identity == arch(blocks=7, thickness=0.3).identity == arch(7, 1.0, 0.3).identity
    assert text.identity == arch(np.int64(7), thickness=np.float64(0.3)).identity  # type: ignore[arg-type]
    assert arch().name == build("arch:blocks=15,thickness=0.2").name == "arch"


def test_density_and_friction_go_with_every_structure() -> None:
    assembly = build("wall:friction=0.7,density=1800")
    assert assembly.friction == 0.7
    assert set(assembly.density) == {1800.0}
    assert build(assembly.name).identity == assembly.identity
    assert build("wall:friction=0.7", friction=0.3, density=900).name == "wall:density=900,friction=0.3"


@pytest.mark.parametrize(("spec", "known"), [("vault", True), ("arch:blocks=3", True), ("./arch", False), ("", False)])
def test_is_built_in(spec: str, known: bool) -> None:
    assert is_built_in(spec) is known


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("arhc", "no built-in structure 'arhc'; did you mean arch?"),
        ("zzz", "choose arch, catenary, dome"),
        ("arch:block=3", "arch has no parameter 'block'; it has blocks, radius, thickness, depth, density, friction"),
        ("arch:blocks=x", "arch: blocks is x; give a whole number from 3 to 1000"),
        ("arch:blocks=2", "arch: blocks is 2; give a whole number from 3"),
        ("arch:blocks=3.5", "arch: blocks is 3.5; give a whole number"),
        ("arch:blocks=1e400", "give a whole number"),
        ("arch:radius=nan", "arch: radius is nan; give a number from 0.01 to 100 m"),
        ("arch:radius=inf", "give a number from 0.01 to 100 m"),
        ("arch:radius=-1", "give a number from 0.01 to 100 m"),
        ("arch:blocks", "arch: 'blocks' is not name=value, such as blocks=15"),
        ("arch:blocks=4,", "is not name=value"),
        ("arch:blocks=4,blocks=5", "arch: blocks is given twice"),
        ("arch:friction=x", "arch: friction is x; give a number"),
        ("arch:thickness=2", "arch: thickness 2 m is more than radius 1 m"),
        ("catenary:rise=100", "catenary: rise 100 m does not suit span 2 m"),
        ("catenary:thickness=1", "catenary: thickness 1 m is too much for the curve at the crown"),
        ("dome:thickness=2", "dome: thickness 2 m is more than radius 1 m"),
        ("dome:stagger=2", "dome: stagger is 2"),
        ("vault:rise=3", "vault: rise 3 m is more than half of span 4 m"),
        ("vault:support=2", "vault: support 2 m is more than 0.4 of span 4 m"),
        ("vault:parts=1000,thickness=4,rise=2", "vault: thickness 4 m is too much"),
        ("vault:thickness=30,rise=2", "vault: thickness 30 m is too much"),
        ("vault:parts=12", "vault: parts is 12; give a whole number from 30 to 10000"),
        ("corbel:span=50", "corbel: blocks of 0.7 m cannot rest on each other in steps of 5 m"),
        ("bottle:pieces=100", "bottle: found no 100 pieces"),
        ("polycube:seed=-1", "polycube: seed is -1"),
    ],
)
def test_bad_specifications_get_one_line(spec: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        build(spec)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("spec", ["arch:friction=-1", "arch:density=0"])
def test_material_out_of_range(spec: str) -> None:
    with pytest.raises(AssemblyError):
        build(spec)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((), {"block": 3}),
        ((3, 1.0, 0.2, 0.4, 5), {}),
        ((3,), {"blocks": 3}),
        ((True,), {}),
        ((None,), {}),
        (("many",), {}),
        ((3.5,), {}),
        ((math.nan,), {}),
        (([3, 4],), {}),
    ],
)
def test_bad_python_arguments(arguments: tuple, named: dict) -> None:
    with pytest.raises(InputError) as caught:
        arch(*arguments, **named)
    assert str(caught.value).startswith("arch")
