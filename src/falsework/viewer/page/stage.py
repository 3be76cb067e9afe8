"""Surroundings of the scene: light, floor and first view, the same on the page and in files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falsework.viewer.appearance import bounds_of
from falsework.viewer.arms import bounds_with_arms
from falsework.viewer.page.scene import SIZE, ViserScene

if TYPE_CHECKING:
    from falsework.viewer.arms import Arms

NARROW = 576
"""Width of a window, pixels, up to which controls are below the scene."""
_SHADOWS_UP_TO = 400
"""Largest number of parts that cast shadows."""


def set_stage(server: Any, scene: ViserScene, arms: Arms | None, *, aside: bool) -> None:
    """Add light and floor, and place the camera.

    Args:
        arms: robots that must be seen too.
    """
    node = server.scene
    node.set_up_direction("+z")
    node.configure_environment_map(None)
    node.configure_default_lights(enabled=True, cast_shadow=scene.assembly.part_count <= _SHADOWS_UP_TO)
    node.world_axes.visible = False
    node.add_grid(
        "/floor", 3 * SIZE, 3 * SIZE, position=(0.0, 0.0, -0.002 * SIZE), cell_color=(228, 229, 231),
        section_color=(210, 212, 215), infinite_grid=False,
    )  # fmt: skip
    node.add_light_ambient("/ambient", color=(255, 255, 255), intensity=0.85)
    right = np.array([0.80, 0.60, 0.0]) * 0.17 * SIZE * aside
    _aim(server.initial_camera, scene, arms, right)


def aim_upright(camera: Any, scene: ViserScene, arms: Arms | None, aspect: float) -> None:
    """Place the camera of a narrow window, whose controls cover the lower half.

    Args:
        arms: robots that must be seen too.
    """
    _aim(camera, scene, arms, np.array([0.0, 0.0, -0.25 * SIZE]), 1.05 / max(aspect, 0.1))


def _aim(camera: Any, scene: ViserScene, arms: Arms | None, beside: NDArray[np.float64], farther: float = 1.0) -> None:
    """Look at the structure from the front, with the middle of the picture beside it."""
    far = farther
    if arms is not None:  # arms reach beyond the structure
        box = bounds_with_arms(arms, bounds_of(scene.assembly))
        far *= max(0.8 * float(np.linalg.norm(np.ptp(box, axis=0))) * scene.scale / SIZE, 1.0)
    target = np.array([0.0, 0.0, 0.42 * scene.height]) + beside * far
    camera.position = np.array([0.97, -1.30, 0.86]) * far * SIZE + target
    camera.look_at = target
    camera.fov = np.radians(36.0)
