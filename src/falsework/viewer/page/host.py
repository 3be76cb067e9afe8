"""Interface of the page, as its controls need it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol

from falsework.viewer.page.scene import ViserScene
from falsework.viewer.page.viewer_state import ViewerState


class Host(Protocol):
    """Page with controls."""

    model: ViewerState
    scene: ViserScene

    @property
    def file_name(self) -> str:
        """Name of downloaded files, without an ending."""

    @property
    def asks(self) -> bool:
        """Whether the proof of the present state is needed."""

    def guard(self, event: Any, act: Callable[[], object]) -> None:
        """Run an action, and report an error in one line; the page continues."""

    def quiet(self) -> AbstractContextManager[None]:
        """Change controls without handling their events."""

    def refresh(self) -> None:
        """Update scene and texts from the model."""

    def draw(self) -> None:
        """Update what moves within a step."""

    def plan_changed(self, words: str) -> None:
        """Show another plan of the model, and say why, in Markdown."""

    def pause(self) -> None:
        """Pause playing."""

    def show(self, model: ViewerState) -> None:
        """Show another model instead of the present one."""
