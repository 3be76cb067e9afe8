"""Pictures in memory, which notebooks show and files keep."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from falsework.errors import InputError
from falsework.utils.display.fonts import fitting_fonts
from falsework.utils.files.output_file import write_whole
from falsework.utils.lazy import importing
from falsework.viewer.pictures.contact_sheet import check_suffix, import_pillow

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Kind = Literal["png", "svg"]


@dataclass(frozen=True)
class PictureReport:
    """Contents of a picture or video."""

    shows: str
    """In words."""
    places: tuple[int, ...] = ()
    """Places of the timeline that are drawn."""
    unstable: tuple[int, ...] | None = None
    """Places whose states are not stable; None where no verdicts were asked for."""
    visited: int | None = None
    """States of a graph that the policy visits; None without a policy."""
    pictures: int = 1
    """Number of pictures of a video."""


@dataclass(frozen=True)
class Picture(PictureReport):
    """Picture with a report of its contents. Notebooks show it."""

    content: bytes = field(default=b"", repr=False)
    """PNG or SVG file."""
    kind: Kind = "png"

    def save(self, path: Path | str) -> None:
        """Write the file, whole or not at all."""
        check_suffix(path, f".{self.kind}")
        write_whole(path, lambda file: file.write(self.content))

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, Any]:
        if self.kind == "svg":
            return {"text/plain": repr(self), "image/svg+xml": self.content.decode("utf-8")}
        return {"text/plain": repr(self), "image/png": self.content}


def png_of(pixels: NDArray[np.uint8]) -> bytes:
    """Return a PNG file of pixels of shape (height, width, 3)."""
    file = io.BytesIO()
    import_pillow().Image.fromarray(pixels).save(file, format="PNG", optimize=True)
    return file.getvalue()


def svg_of(text: str) -> bytes:
    """Return an SVG file of its text."""
    return text.encode("utf-8", "backslashreplace")


def figure_class(what: str) -> Any:
    """Return the class of figures of matplotlib.

    Args:
        what: needs it, in the plural.
    """
    with importing(f"{what} need matplotlib; pip install 'falsework[picture]'"):
        from matplotlib.figure import Figure
    return Figure


def save_figure(figure: Any, path: Path, dpi: float) -> None:
    """Write a figure of matplotlib as PNG or SVG, whole or not at all."""
    form = path.suffix.lower()[1:]
    if form not in ("png", "svg"):
        raise InputError(f"{path} is neither PNG nor SVG; name a file that ends in .png or .svg")
    with fitting_fonts(figure):
        write_whole(path, lambda file: figure.savefig(file, format=form, dpi=dpi))


def figure_of(figure: Any, kind: Kind) -> bytes:
    """Return a file of a figure of matplotlib."""
    file = io.BytesIO()
    with fitting_fonts(figure):
        figure.savefig(file, format=kind, dpi=150, bbox_inches="tight", pad_inches=0.08)
    return file.getvalue()
