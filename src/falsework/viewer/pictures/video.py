"""Video of a timeline: MP4 through the ffmpeg of imageio-ffmpeg, or GIF."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.robots.cells.visuals import PLAIN
from falsework.utils.files.output_file import write_whole
from falsework.utils.lazy import importing
from falsework.utils.quantity import check_step_seconds
from falsework.viewer.appearance import bounds_of
from falsework.viewer.arms import TINT, Arms, bounds_with_arms
from falsework.viewer.arrows import arrows_of_step
from falsework.viewer.palette import BOUNDARY, INSTALLED, ROBOTS, SLIDING, rgb
from falsework.viewer.pictures.contact_sheet import (
    PALE,
    Pixels,
    bounds_with_motions,
    caption,
    import_pillow,
    legend,
    one_state,
    outline_of,
)
from falsework.viewer.pictures.gantt import strip_of
from falsework.viewer.pictures.render import Camera
from falsework.viewer.proof import StateProof
from falsework.viewer.timeline import Timeline

HOLD = 1.0
"""Seconds that the first and the last picture stay."""
KINDS = (".mp4", ".gif")


def frames_of(
    timeline: Timeline,
    *,
    seconds: float,
    rate: float,
    camera: Camera,
    speed: float = 1.0,
    arms: Arms | None = None,
    proofs: Mapping[int, StateProof] | None = None,
) -> Iterator[Pixels]:
    """Yield pictures of a video, one after the other.

    Args:
        seconds: length of a step; a robot plan plays by its own clock instead.
        speed: seconds of a robot plan that pass in a second.
        proofs: verdicts on states, by place; sliding parts are marked, and verdicts other than stable are written
            above.
    """
    box = bounds_with_motions(timeline) if arms is None else bounds_with_arms(arms, bounds_of(timeline.assembly))
    outline = outline_of(timeline, camera, box)
    sliding = any(proof.slides for proof in (proofs or {}).values())
    still = max(round(HOLD * rate), 1)
    moments = _moments(timeline, arms, seconds, rate, speed)
    chart = None if arms is None else strip_of(arms.plan, camera.width)
    for number, (position, time) in enumerate(moments):
        # One after the other, a step is written as soon as it begins; else the last that the structure has come to.
        step = timeline.next(position) if time is None else timeline.row(position)
        proof = (proofs or {}).get(step)
        marks = None if proof is None else proof.marks
        picture = one_state(
            timeline,
            position,
            camera,
            bounds=box,
            words=caption(timeline, step, proof) if time is None else f"{time:.1f} s, {caption(timeline, step, proof)}",
            arrows=list(arrows_of_step(timeline, step).values()),
            key=legend(timeline, sliding, any(timeline.presses), outlined=True),
            arms=arms,
            time=time,
            marks=marks,
            outline=outline,
        )
        if chart is not None and time is not None:
            picture = np.concatenate([picture, chart.marked(time)])
        repeat = still if number in (0, len(moments) - 1) else 1
        for _ in range(repeat):
            yield picture


def _moments(
    timeline: Timeline, arms: Arms | None, seconds: float, rate: float, speed: float
) -> list[tuple[float, float | None]]:
    """Return the place of every picture, and its time if there are arms."""
    if arms is None:
        return [(abs(place - timeline.begin), None) for place in frame_places(len(timeline), seconds, rate)]
    return [(arms.clock.position(time), time) for time in frame_times(arms.clock.makespan, rate, speed)]


def frame_times(makespan: float, rate: float, speed: float) -> list[float]:
    """Return times of a robot plan that are shown, in seconds."""
    _check_rate(rate)
    if not (np.isfinite(speed) and 0 < speed <= 1000):
        raise InputError(f"a film at {speed:g} times the speed cannot be seen; give a number above zero, to 1000")
    last = int(np.ceil(makespan * rate / speed - 1e-9))
    return [min(number * speed / rate, makespan) for number in range(last)] + [makespan]


def _check_rate(rate: float) -> None:
    if not (np.isfinite(rate) and 1 <= rate <= 120):
        raise InputError(f"{rate:g} pictures a second make no video; give 1 to 120")


def frame_places(steps: int, seconds: float, rate: float) -> list[float]:
    """Return places of a timeline that are shown, in steps."""
    check_step_seconds(seconds)
    _check_rate(rate)
    each = max(round(seconds * rate), 1)
    return [min(number / each, float(steps)) for number in range(steps * each + 1)]


def write_film(
    path: Path | str,
    timeline: Timeline,
    *,
    seconds: float,
    rate: float,
    speed: float,
    camera: Camera,
    arms: Arms | None = None,
    proofs: Mapping[int, StateProof] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Write a video, whole or not at all.

    Args:
        proofs: as for `frames_of`.
        progress: called with the number of pictures drawn and of all.

    Returns:
        Number of pictures.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in KINDS:
        raise InputError(f"{path} ends in {kind or 'nothing'}; videos are written as {' or '.join(KINDS)}")
    even = replace(camera, width=camera.width + camera.width % 2)
    total = len(_moments(timeline, arms, seconds, rate, speed)) + 2 * (max(round(HOLD * rate), 1) - 1)
    pictures = frames_of(timeline, seconds=seconds, rate=rate, speed=speed, camera=even, arms=arms, proofs=proofs)

    def counted() -> Iterator[Pixels]:
        for number, picture in enumerate(pictures):
            if progress is not None:
                progress(number, total)
            yield picture

    return _write_gif(path, counted(), rate) if kind == ".gif" else _write_mp4(path, counted(), rate)


def _write_gif(path: Path, pictures: Iterator[Pixels], rate: float) -> int:
    pillow = import_pillow()
    palette = pillow.Image.new("P", (1, 1))
    palette.putpalette(_gif_colors().ravel().tolist())
    none = pillow.Image.Dither.NONE
    frames = [pillow.Image.fromarray(picture).quantize(palette=palette, dither=none) for picture in pictures]
    each = round(1000 / rate)

    def save(file: Any) -> None:
        frames[0].save(
            file, format="GIF", save_all=True, append_images=frames[1:], duration=each, loop=0, optimize=True
        )

    write_whole(path, save)
    return len(frames)


def _gif_colors() -> NDArray[np.uint8]:
    """Return the 256 colours of all frames, so that none flickers: every colour of the scheme in light and shade.

    Links of arms and the outline of what is not installed are in it, too. Shape (256, 3).
    """
    named = np.array([rgb(color) for color in (INSTALLED, BOUNDARY, *ROBOTS, SLIDING)], dtype=float)
    links = 255 * (1 - TINT) * np.array(PLAIN) + TINT * named[2 : 2 + len(ROBOTS)]

    def shades(colors: NDArray[np.float64], number: int) -> NDArray[np.float64]:
        return (np.linspace(0.4, 1.06, number)[None, :, None] * colors[:, None]).reshape(-1, 3)

    grey = np.repeat(np.linspace(0, 255, 24)[:, None], 3, axis=1)
    pale = 255 - np.linspace(0.25, 0.75, 6)[None, :, None] * (255 - named[:, None])
    outline = 255 - PALE * (255 - shades(named[:2], 6))
    every = np.concatenate([grey, shades(named, 14), shades(links, 6), pale.reshape(-1, 3), outline])
    return np.clip(np.concatenate([every, np.zeros((256 - len(every), 3))]), 0, 255).round().astype(np.uint8)


def _write_mp4(path: Path, pictures: Iterator[Pixels], rate: float) -> int:
    with importing("MP4 needs imageio-ffmpeg; install it with pip install 'falsework[picture]', or write a .gif"):
        import imageio_ffmpeg
    count = 0
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "video.mp4"
        writer = None
        for picture in pictures:
            if writer is None:
                height, width = picture.shape[:2]
                writer = imageio_ffmpeg.write_frames(
                    str(draft),
                    (width, height),
                    fps=rate,  # type: ignore[arg-type]  # any number will do
                    macro_block_size=2,
                    quality=7,
                    ffmpeg_log_level="error",
                )
                writer.send(None)
            writer.send(np.ascontiguousarray(picture))
            count += 1
        if writer is not None:
            writer.close()
        content = draft.read_bytes()
    write_whole(path, lambda file: file.write(content))
    return count
