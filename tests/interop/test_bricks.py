"""Bricks joined by studs: StableLego's hand-checked structures, and files written by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import StabilityOracle, StabilitySettings, Verdict, load_structure
from falsework.assembly import complete_state
from falsework.errors import AssemblyError, InputError
from falsework.interop import Brick, assemble_bricks
from falsework.interop.bricks import PLATE

STICK = [
    (0, 0, 8), (6, 1, 4), (8, 2, 4), (10, 3, 8), (16, 2, 8), (22, 3, 6), (26, 2, 6), (30, 3, 6), (34, 2, 6), (38, 3, 6),
    (42, 2, 6), (44, 3, 4), (44, 4, 4),
]  # fmt: skip
"""Place along x, layer and length of bricks one stud wide (StableLego, `stick_light`); in reality it stands."""

ON_A_PLATE = pytest.mark.filterwarnings("ignore:.*a baseplate under the lowest layer was added")
"""Lets the warning pass that `test_the_baseplate_is_told` is about."""


def stair(steps: int) -> list[Brick]:
    """Bricks of 4 by 2 studs, each two studs farther out than the one below."""
    return [Brick((40 * step, 0, 24 * step), (4, 2)) for step in range(steps)]


def stick(bricks: list[tuple[int, int, int]]) -> list[Brick]:
    return [Brick((20 * x, 0, 24 * z), (length, 1)) for x, z, length in bricks]


def verdict(bricks: list[Brick], criterion: str = "equilibrium", **options: Any) -> int:
    assembly = assemble_bricks(bricks, **options)
    oracle = StabilityOracle(assembly, StabilitySettings(criterion=criterion))  # type: ignore[arg-type]
    return int(oracle.verdicts(complete_state(assembly.boundary), require_certificate=True).verdict[0])


@pytest.mark.parametrize("criterion", ["equilibrium", "contact"])
@pytest.mark.parametrize(
    ("bricks", "stands"),
    [
        (stair(19), True),
        (stair(20), False),
        ([*stair(20), Brick((80, 0, 0), (2, 1))], True),
        (stick(STICK), True),
        (stick([*STICK, (44, 5, 4)]), False),
    ],
    ids=["stair of 19", "stair of 20", "stair of 20, propped", "stick", "stick with a heavier end"],
)
def test_structures_that_were_built_and_stood_or_fell(bricks: list[Brick], stands: bool, criterion: str) -> None:
    """The five that StableLego's authors built by hand and give all data of."""
    assert verdict(bricks, criterion) == (Verdict.STABLE if stands else Verdict.UNSTABLE)


@pytest.mark.parametrize("criterion", ["equilibrium", "contact"])
@pytest.mark.parametrize("share", [0.97, 1.03])
def test_a_brick_hangs_by_its_studs(criterion: str, share: float) -> None:
    """A single stud bears four times the tension of a point: closed form."""
    top, below = Brick((0, 0, 24), (1, 1)), Brick((0, 0, 0), (1, 1))
    tension = share * 9.81 * below.mass / 4
    expected = Verdict.STABLE if share > 1 else Verdict.UNSTABLE
    assert verdict([top, below], criterion, boundary=[0], tension=tension) == expected


def test_masses_are_those_of_the_bricks() -> None:
    assembly = assemble_bricks([Brick((0, 0, 0), (4, 2)), Brick((0, 0, 24), (1, 2)), Brick((0, 0, 48), (1, 3))])
    np.testing.assert_allclose(assembly.mass.mass[:3], [2.16e-3, 0.81e-3, 1.185e-3])


def test_plates_weigh_what_walls_and_tubes_leave() -> None:
    """Of 2 by 4 studs: sides of 1.5 mm and three tubes, 6.4 mm lower than the brick's 2.16 g; the top is the same."""
    sides, tubes = 31.8 * 15.8 - 28.8 * 12.8, 3 * 15.2
    assert Brick((0, 0, 0), (4, 2), PLATE).mass == pytest.approx(2.16e-3 - 1.05e-6 * 6.4 * (sides + tubes))
    assert 0.9e-3 < Brick((0, 0, 0), (4, 2), PLATE).mass < 1.0e-3
    assert 0.15e-3 < Brick((0, 0, 0), (1, 1), PLATE).mass < 0.2e-3


@ON_A_PLATE
def test_ldraw_with_plates_and_wide_bricks(tmp_path: Path) -> None:
    """A brick of 4 by 6 studs on two plates, which reach as high as a brick and lie on the baseplate with another."""
    file = tmp_path / "model.ldr"
    lines = [(0, 0, "3032"), (0, -8, "3032"), (0, -32, "2356"), (120, -16, "3001")]
    file.write_text("".join(f"1 4 {x} {y} 0 1 0 0 0 1 0 0 0 1 {part}.dat\n" for x, y, part in lines))
    assembly = load_structure(file)
    heights = [round(1e3 * float(np.ptp(mesh.bounds[:, 2])), 6) for mesh in assembly.meshes[:4]]
    assert heights == [3.2, 3.2, 9.6, 9.6]
    assert assembly.contacts.parts.tolist() == [[0, 1], [0, 4], [1, 2], [3, 4]]
    assert np.diff(assembly.contacts.start).tolist() == [72, 72, 72, 24]
    assert StabilityOracle(assembly).verdicts(complete_state(assembly.boundary), require_certificate=True).stable.all()


@ON_A_PLATE
def test_text_of_brickgpt(tmp_path: Path) -> None:
    file = tmp_path / "table.txt"
    file.write_text("2x4 (0,0,0)\n2x4 (6,0,0)\n\n6x2 (0,1,1)\n4x2 (4,1,1)\n")
    with pytest.raises(AssemblyError, match="bricks 2 and 3 overlap; move one of them"):
        load_structure(file)
    file.write_text("2x4 (0,0,0)\n2x4 (6,0,0)\n\n6x2 (0,1,1)\n2x2 (6,1,1)\n4x2 (4,1,2)\n")
    assembly = load_structure(file)
    file.write_text("\ufeff" + file.read_text(), encoding="utf-8")  # as editors of Windows save it
    assert load_structure(file).identity == assembly.identity
    assert assembly.names == ("0", "1", "2", "3", "4", "baseplate")
    assert assembly.boundary.tolist() == [False] * 5 + [True]
    np.testing.assert_allclose(assembly.meshes[2].bounds, [[0.1e-3, 8.1e-3, 9.6e-3], [47.9e-3, 23.9e-3, 19.2e-3]])
    assert assembly.contacts.parts.tolist() == [[0, 2], [0, 5], [1, 3], [1, 5], [2, 4], [3, 4]]
    assert np.diff(assembly.contacts.start).tolist() == [12, 24, 12, 24, 12, 12]
    for criterion in ("equilibrium", "contact"):
        oracle = StabilityOracle(assembly, StabilitySettings(criterion=criterion))  # type: ignore[arg-type]
        assert oracle.verdicts(complete_state(assembly.boundary), require_certificate=True).stable.all()


LDRAW = """0 A table
0 FILE main.ldr
1 4 40 0 0 1 0 0 0 1 0 0 0 1 3001.dat
1 4 30 -24 20 0 0 1 0 1 0 -1 0 0 3004.DAT
1 2 0 -48 0 1 0 0 0 1 0 0 0 1 top.ldr
0 FILE top.ldr
1 4 40 0 0 0 0 -1 0 1 0 1 0 0 3003.dat
"""


@ON_A_PLATE
def test_ldraw_with_a_model_in_it(tmp_path: Path) -> None:
    file = tmp_path / "model.mpd"
    file.write_text(LDRAW)
    assembly = load_structure(file)
    bounds = [1e3 * mesh.bounds for mesh in assembly.meshes]
    np.testing.assert_allclose(bounds[0], [[0.1, -7.9, -9.6], [31.9, 7.9, 0.0]], atol=1e-9)
    np.testing.assert_allclose(bounds[1], [[8.1, 0.1, 0.0], [15.9, 15.9, 9.6]], atol=1e-9)
    np.testing.assert_allclose(bounds[2], [[8.1, -7.9, 9.6], [23.9, 7.9, 19.2]], atol=1e-9)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.txt", "2x4 (0,0,0)\n2x4 0,0,1\n", "line 2: '2x4 0,0,1' is not a brick such as 2x4 (3,0,1)"),
        ("a.txt", "0x4 (0,0,0)\n", "line 1: '0x4 (0,0,0)' is not a brick"),
        ("a.txt", "00x4 (0,0,0)\n", "line 1: '00x4 (0,0,0)' is not a brick"),
        ("a.txt", "2x4 (-1,0,0)\n", "line 1: '2x4 (-1,0,0)' is not a brick such as 2x4 (3,0,1), in whole numbers"),
        ("a.txt", "2x4 (0.5,0,0)\n", "line 1: '2x4 (0.5,0,0)' is not a brick"),
        ("a.txt", "2x4 (99999999999999999999,0,0)\n", "is not a brick"),
        ("a.txt", "2x4 (0,0,0)\n2x4 (0,0,2)\n", "touches no other part"),
        ("a.ldr", "0 nothing\n", "has no parts"),
        ("a.ldr", "1 4 0 0 0 1 0 0 0 1 0 0 0 1 3039.dat\n", "part 3039.dat is not a known brick: 3005, 3004"),
        ("a.ldr", "1 4 0 0 0 1 0 0 0 1 0 0 3001.dat\n", "line 1: no place and turn of a part"),
        ("a.ldr", "1 4 0 0 0 1 0 0 0 -1 0 0 0 1 3001.dat\n", "brick 3001.dat is not upright along the axes"),
        ("a.ldr", "1 4 0 0 0 .8 0 .6 0 1 0 -.6 0 .8 3001.dat\n", "brick 3001.dat is not upright along the axes"),
        ("a.ldr", "1 4 0 0 0 2 0 0 0 1 0 0 0 1 3001.dat\n", "brick 3001.dat is not upright along the axes, or scaled"),
        ("a.ldr", "1 4 nan 0 0 1 0 0 0 1 0 0 0 1 3001.dat\n", "line 1: no place and turn of a part"),
        ("a.mpd", "0 FILE x\n1 4 0 0 0 1 0 0 0 1 0 0 0 1 x\n", "model x contains itself"),
        (
            "a.ldr",
            "1 4 0 0 0 1 0 0 0 1 0 0 0 1 3001.dat\n1 4 10 -24 0 1 0 0 0 1 0 0 0 1 3001.dat\n",
            "brick 1 lies on brick 0, but their studs do not meet; move one by whole studs",
        ),
    ],
)
def test_bricks_that_cannot_be_read(tmp_path: Path, name: str, text: str, message: str) -> None:
    file = tmp_path / name
    file.write_text(text)
    with pytest.raises(InputError) as refused:
        load_structure(file)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_bricks_take_no_friction_of_their_own(tmp_path: Path) -> None:
    file = tmp_path / "a.txt"
    file.write_text("2x4 (0,0,0)\n")
    with pytest.raises(InputError, match="have their own friction; leave it out"):
        load_structure(file, friction=0.5)
    with pytest.raises(AssemblyError, match="the tension of a stud is -1 N"):
        assemble_bricks([Brick((0, 0, 0), (1, 1))], tension=-1.0)
