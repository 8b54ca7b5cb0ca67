"""``gvtools film``: a path through a memory as MP4, GIF or WebP."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from gvtools.errors import OptionError
from pipelines.options import Arguments

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from gvtools.cameras import Cameras
    from pipelines.console import Console

SUMMARY = "write a film of a path through a memory"
EXAMPLES = (
    "gvtools film runs/kitchen --path spiral:240 --out kitchen.mp4",
    "gvtools film runs/kitchen --path orbit:120 --compare observed,completed --out both.mp4",
    "gvtools film runs/kitchen --path interpolate:60 --growth --width 480 --out growth.gif",
)


class FilmArguments(Arguments):
    """The command's arguments."""

    positional = ("memory",)
    exclusive = (("complete", "depth", "compare"),)

    memory: Path
    """A run or a memory.npz. [RUN_OR_MEMORY]"""
    path: str = "interpolate"
    """orbit:N, spiral:N, interpolate:N (N frames, 120 by default), cameras (the captured views), a
    TUM or KITTI file, a transforms.json such as 'gvtools view' saves, or a project (the last two
    also PATH@SELECTION). [PATH]"""
    out: Path
    """FILE.mp4, FILE.gif or FILE.webp. [FILE]"""
    fps: float = Field(24.0, gt=0, le=240)
    """Frames a second. [N]"""
    width: int | None = Field(None, ge=16)
    """Of a panel; the height follows (the cameras'). [pixels]"""
    round: int | None = None
    """The memory as it was after round R. [R]"""
    complete: bool = False
    """Fill what the memory leaves open (inpaint)."""
    depth: bool = False
    """Depth in colours, near is red."""
    compare: str | None = None
    """Panels side by side, of memory, observed, completed, depth. [A,B]"""
    growth: bool = False
    """The path once for each round, as memory was then."""


def run(args: FilmArguments, console: Console) -> None:
    """Draw and write the film."""
    from gvtools.runs.run import load_memory
    from pipelines.film import check_suffix, film_cameras, write_film

    check_suffix(args.out)
    if args.growth and args.round is not None:
        raise OptionError("--growth shows every round; leave --round out")
    panels = _panels(args)
    memory = load_memory(args.memory, up_to=args.round)
    if not len(memory):
        raise OptionError(f"{args.memory}: an empty memory; expected one that views were fused in")
    cameras = film_cameras(memory, args.path, width=args.width)
    rounds = memory.rounds if args.growth else (args.round,)
    del memory
    start = time.perf_counter()
    spent = [0.0]
    frames = _frames(args, cameras, rounds, panels=panels, console=console, spent=spent)
    write_film(args.out, frames, fps=args.fps)
    count = len(cameras) * len(rounds)
    each = (time.perf_counter() - start) / count
    console.line(
        f"{args.out}: {count} frames of {len(panels) * int(cameras.width[0])}x"
        f"{int(cameras.height[0])}, {count / args.fps:.1f} s; {each:.3f} s a frame, of which "
        f"projecting {spent[0] / count:.3f}"
    )


def _panels(args: FilmArguments) -> tuple[str, ...]:
    from pipelines.film import PANELS

    if args.complete:
        return ("completed",)
    if args.depth:
        return ("depth",)
    if args.compare is None:
        return ("memory",)
    panels = tuple(args.compare.split(","))
    unknown = [panel for panel in panels if panel not in PANELS]
    if unknown or len(panels) < 2:
        raise OptionError(
            f"--compare {args.compare!r}; expected two or more of {', '.join(PANELS)}, by commas"
        )
    return panels


def _frames(
    args: FilmArguments,
    cameras: Cameras,
    rounds: tuple[int | None, ...],
    *,
    panels: tuple[str, ...],
    console: Console,
    spent: list[float],
) -> Iterator[NDArray[np.uint8]]:
    """All frames in order; ``spent`` receives the seconds of projecting."""
    import numpy as np

    from pipelines.film import FilmRenderer, captioned

    for number in rounds:
        renderer = FilmRenderer(args.memory, cameras, up_to=number)
        label = "drawing frames" if not args.growth else f"drawing frames of round {number}"
        for index in console.track(range(len(cameras)), label):
            frame = renderer.frame(index, panels)
            if len(panels) > 1:
                parts = np.split(frame, len(panels), axis=1)
                pairs = zip(parts, panels, strict=True)
                frame = np.concatenate([captioned(part, panel) for part, panel in pairs], axis=1)
            if args.growth:
                frame = captioned(frame, f"round {number}") if len(panels) == 1 else frame
            yield frame
        spent[0] += renderer.projecting
