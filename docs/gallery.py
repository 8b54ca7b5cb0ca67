"""The gallery: what commands make of the samples, and the page that shows it.

Run by the documentation's build. What it made is kept in ``build/gallery``; take that folder away
to have it made anew.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "build" / "gallery"
# Longer side of a still picture, px.
SIDE = 1200
SAMPLES = ("gvtools demo --out room", "gvtools demo --sample motorcycle --out motorcycle")


@dataclass(frozen=True)
class Exhibit:
    """One thing to see."""

    title: str
    text: str
    command: str  # that makes it of the samples' runs
    file: str  # of what it writes

    @property
    def shown(self) -> str:
        """The name of the file on the page."""
        path = Path(self.file)
        return f"{path.stem}.webp" if path.suffix in (".png", ".jpg") else path.name

    def markdown(self) -> str:
        """Its part of the page."""
        place = f"gallery/{self.shown}"
        if self.shown.endswith(".html"):
            look = (
                f'<iframe src="{place}" title="{self.title}" loading="lazy" width="100%" '
                f'height="480" style="border: 0"></iframe>\n\n[Alone in the window]({place})'
            )
        else:
            look = f"![{self.title}]({place})"
        return f"## {self.title}\n\n{look}\n\n{self.text}\n\n```\n{self.command}\n```\n"


EXHIBITS = (
    Exhibit("A room to walk through",
            "Drag, or walk with W A S D. Eight pictures were given; *generated* hides what a "
            "completer made of the rest, the slider what came with later rounds.",
            "gvtools export room --format html --out room.html", "room.html"),
    Exhibit("What was seen, and what was filled in",
            "Left what the eight pictures show from an orbit, white where nobody looked; right the "
            "same views completed.",
            "gvtools film room --path orbit:16 --fps 8 --compare observed,completed --width 320 "
            "--out orbit.webp", "orbit.webp"),
    Exhibit("Round by round", "Two given views, then targets of each round, as completed; below "
            "the pictures that nobody was given.",
            "gvtools plot frames room --out frames.png", "frames.png"),
    Exhibit("The memory knows where a point comes from",
            "Blue was observed, orange generated, white is unknown.",
            "gvtools view room --color source --camera target_08.png --screenshot sources.png",
            "sources.png"),
    Exhibit("All around",
            "A panorama from a camera that looked ahead; a plain fill completes what is open.",
            "gvtools render room --cameras room-sample --views first:1 --lens equirectangular "
            "--complete --width 1024 --out panorama", "panorama/context_00.jpg"),
    Exhibit("Cameras", "The given ones and the targets, from above and from the side.",
            "gvtools plot trajectories room --out trajectories.svg", "trajectories.svg"),
    Exhibit("One photograph and its depth", "One view of the Middlebury benchmark's pair, with "
            "its depth, was given; cameras beside it are completed.",
            "gvtools export motorcycle --format html --out motorcycle.html", "motorcycle.html"),
)  # fmt: skip


def gallery_page() -> str:
    """The page, in Markdown."""
    samples = "\n".join(SAMPLES)
    head = (
        "# Gallery\n\nAll of this was made by the commands that stand below each, of two samples "
        f"that need no download:\n\n```\n{samples}\n```\n"
    )
    return "\n".join([head, *(exhibit.markdown() for exhibit in EXHIBITS)])


def gallery_files() -> list[Path]:
    """What the page shows; made first where it is not there."""
    if not FOLDER.is_dir():
        FOLDER.parent.mkdir(exist_ok=True)
        with TemporaryDirectory(dir=FOLDER.parent) as folder:
            made = Path(folder) / "made"
            made.mkdir()
            for command in (*SAMPLES, *(exhibit.command for exhibit in EXHIBITS)):
                words = [sys.executable, "-m", *shlex.split(command), "--quiet"]
                environment = {**os.environ, "PYTHONPATH": str(ROOT)}
                subprocess.run(words, cwd=folder, env=environment, check=True)
            for exhibit in EXHIBITS:
                _show(Path(folder) / exhibit.file, made / exhibit.shown)
            made.rename(FOLDER)
    return sorted(FOLDER.iterdir())


def _show(file: Path, shown: Path) -> None:
    """A picture for the page of one that a command has written; other files as they are."""
    if file.suffix == shown.suffix:
        file.rename(shown)
        return
    with Image.open(file) as picture:
        small = picture.convert("RGB")
    small.thumbnail((SIDE, SIDE))
    small.save(shown, quality=85)
