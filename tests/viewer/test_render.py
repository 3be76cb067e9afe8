"""The renderer behind all pictures."""

from __future__ import annotations

import numpy as np
import pytest

from falsework.errors import InputError
from falsework.viewer import Camera
from falsework.viewer.pictures.contact_sheet import write_text
from falsework.viewer.pictures.render import ColoredSolid, render

BOX = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = np.array([triangle for a, b, c, d in QUADS for triangle in ((a, b, c), (a, c, d))])
RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)
BOUNDS = np.array([[-4.0, -8.0, -2.0], [4.0, 8.0, 2.0]])


@pytest.mark.parametrize("red_in_front", [True, False])
@pytest.mark.parametrize("red_first", [True, False])
def test_what_is_nearer_hides_what_is_farther(red_in_front: bool, red_first: bool) -> None:
    """Seen along +y, whatever the order in which the boxes are drawn."""
    red = ColoredSolid(BOX + [0, -5.0 if red_in_front else 5.0, 0], FACES, RED)
    blue = ColoredSolid(BOX + [0, 5.0 if red_in_front else -5.0, 0], FACES, BLUE)
    camera = Camera(azimuth=0.0, elevation=1.0, width=81, height=61)
    image = render([red, blue] if red_first else [blue, red], camera, BOUNDS, floor=False)
    assert image.shape == (61, 81, 3)
    middle = image[30, 40]
    assert (middle[0] > middle[2]) == red_in_front
    assert (image[0, 0] == 1.0).all()  # nothing there


def test_size_in_pixels_is_size_in_metres_times_scale() -> None:
    camera = Camera(azimuth=0.0, elevation=0.001, width=161, height=121)
    image = render([ColoredSolid(BOX, FACES, RED)], camera, BOUNDS, floor=False)
    scale, _ = camera.fit(BOUNDS)
    covered = (image < 0.99).any(axis=2)
    assert covered.any(axis=0).sum() == pytest.approx(2 * scale, abs=2)
    assert covered.any(axis=-1).sum() == pytest.approx(2 * scale, abs=2)
    corner = camera.project(np.array([1.0, 0.0, 1.0]), BOUNDS)
    assert corner[0] == pytest.approx(np.flatnonzero(covered.any(axis=0))[-1] + 1, abs=2)


@pytest.mark.parametrize("view", [{"azimuth": np.nan}, {"elevation": np.inf}])
def test_a_view_from_nowhere_is_refused(view: dict[str, float]) -> None:
    with pytest.raises(InputError, match="degrees does not exist; give numbers"):
        Camera(**view)  # type: ignore[arg-type]


def test_a_box_casts_a_shadow_on_the_floor() -> None:
    camera = Camera(azimuth=-40.0, elevation=50.0, width=121, height=91)
    lit = render([ColoredSolid(BOX * 0.001 + [0, 0, -1.9], FACES, RED)], camera, BOUNDS)
    shaded = render([ColoredSolid(BOX + [0, 0, 0.5], FACES, RED)], camera, BOUNDS)
    grey = (np.ptp(shaded, axis=2) < 1e-9) & (shaded[..., 0] < 0.95) & (shaded[..., 0] > 0.7)
    assert grey.sum() > 50
    assert (lit[grey] > 0.99).mean() > 0.9  # where the shadow falls there is light without the box


def test_a_ghost_lets_through_what_is_behind() -> None:
    camera = Camera(azimuth=0.0, elevation=1.0, width=81, height=61)
    ghost = ColoredSolid(BOX - [0, 5.0, 0], FACES, RED, 0.5)
    behind = ColoredSolid(BOX + [0, 5.0, 0], FACES, BLUE)
    alone, both = (render(solids, camera, BOUNDS, floor=False)[30, 40] for solids in ([ghost], [ghost, behind]))
    only_blue = render([behind], camera, BOUNDS, floor=False)[30, 40]
    # Half of the ghost's own colour and half of what is there without it.
    np.testing.assert_allclose(both - 0.5 * only_blue, alone - 0.5, atol=1e-6)
    hidden = render(
        [ColoredSolid(ghost.vertices + [0, 8.0, 0], FACES, RED, 0.5), ColoredSolid(BOX - [0, 5.0, 0], FACES, BLUE)],
        camera,
        BOUNDS,
        floor=False,
    )[30, 40]
    np.testing.assert_allclose(
        hidden, render([ColoredSolid(BOX - [0, 5.0, 0], FACES, BLUE)], camera, BOUNDS, floor=False)[30, 40]
    )


def test_nothing_to_see_is_white() -> None:
    assert (render([], Camera(width=20, height=10), BOUNDS, floor=False) == 1.0).all()


def test_letters_beyond_ascii_are_drawn() -> None:
    """A font draws the same box for each letter that it lacks."""
    pytest.importorskip("matplotlib", reason="pictures need Matplotlib")
    images = pytest.importorskip("PIL.Image", reason="pictures need Pillow")
    pens = pytest.importorskip("PIL.ImageDraw", reason="pictures need Pillow")
    letters = "äéøñšłжλ"
    drawn: set[bytes] = set()
    for letter in letters:
        canvas = images.new("L", (40, 40))
        write_text(pens.Draw(canvas), (20, 20), letter, color="white")
        drawn.add(canvas.tobytes())
    assert len(drawn) == len(letters)
