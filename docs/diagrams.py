"""The diagrams of the documentation: boxes on a grid and arrows between them, as SVG."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from textwrap import wrap

ROOT = Path(__file__).resolve().parent.parent

CELL_WIDTH, CELL_HEIGHT = 190, 100
BOX_WIDTH, BOX_HEIGHT = 158, 56
FILLS = {"data": "#e3edf7", "step": "#fdf0d5", "result": "#e2f0e2"}


@dataclass(frozen=True)
class Diagram:
    """A diagram.

    Attributes:
        boxes: key -> (column, row, kind, text); a bar in the text starts a new line.
        arrows: (from, to, label) by keys; they leave at the side that faces the other box.
    """

    boxes: dict[str, tuple[float, float, str, str]]
    arrows: list[tuple[str, str, str]] = field(default_factory=list)

    def svg(self) -> str:
        """The picture as a stand-alone SVG document."""
        width = (max(box[0] for box in self.boxes.values()) + 1) * CELL_WIDTH
        height = (max(box[1] for box in self.boxes.values()) + 1) * CELL_HEIGHT
        parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
            f'width="{width:g}" height="{height:g}" font-family="sans-serif" font-size="13">',
            '<defs><marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" '
            'markerHeight="8" orient="auto"><path d="M0 0 8 4 0 8z" fill="#455a64"/></marker>'
            "</defs>",
            f'<rect width="{width:g}" height="{height:g}" rx="8" fill="#ffffff"/>',
            *(self._arrow(*arrow) for arrow in self.arrows),
            *(_box(*box) for box in self.boxes.values()),
            "</svg>",
        ]
        return "\n".join(parts) + "\n"

    def _arrow(self, start: str, end: str, label: str) -> str:
        (x0, y0), (x1, y1) = (_center(*self.boxes[key][:2]) for key in (start, end))
        if abs(x1 - x0) / CELL_WIDTH >= abs(y1 - y0) / CELL_HEIGHT:
            side = 1 if x1 > x0 else -1
            x0, x1 = x0 + side * BOX_WIDTH / 2, x1 - side * BOX_WIDTH / 2
        else:
            side = 1 if y1 > y0 else -1
            y0, y1 = y0 + side * BOX_HEIGHT / 2, y1 - side * BOX_HEIGHT / 2
        line = (
            f'<path d="M{x0:g} {y0:g} L{x1:g} {y1:g}" stroke="#455a64" stroke-width="1.5" '
            'fill="none" marker-end="url(#head)"/>'
        )
        if not label:
            return line
        place = ((x0 + x1) / 2 + (6 if y0 != y1 else 0), (y0 + y1) / 2 - (6 if y0 == y1 else -4))
        anchor = "middle" if y0 == y1 else "start"
        return line + _text(*place, label, anchor=anchor, size=11)


def _center(column: float, row: float) -> tuple[float, float]:
    return (column + 0.5) * CELL_WIDTH, (row + 0.5) * CELL_HEIGHT


def _text(x: float, y: float, text: str, *, anchor: str = "middle", size: int = 13) -> str:
    return (
        f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}" font-size="{size}" '
        f'fill="#263238">{escape(text)}</text>'
    )


def _box(column: float, row: float, kind: str, text: str) -> str:
    x, y = _center(column, row)
    lines = text.split("|")
    first = y + 4.5 - 8 * (len(lines) - 1)
    return (
        f'<rect x="{x - BOX_WIDTH / 2:g}" y="{y - BOX_HEIGHT / 2:g}" width="{BOX_WIDTH}" '
        f'height="{BOX_HEIGHT}" rx="6" fill="{FILLS[kind]}" stroke="#455a64"/>'
        + "".join(_text(x, first + 16 * i, line) for i, line in enumerate(lines))
    )


DIAGRAMS = {
    "overview": Diagram(
        {
            "scene": (0, 0, "data", "photographs|with poses"),
            "depth": (1, 0, "step", "depth"),
            "fuse": (2, 0, "step", "fuse"),
            "memory": (3, 0, "data", "memory"),
            "project": (3, 1, "step", "project into|target cameras"),
            "complete": (2, 1, "step", "complete|what is unknown"),
            "out": (4, 0, "result", "point cloud, pictures,|figures"),
        },
        [("scene", "depth", ""), ("depth", "fuse", ""), ("fuse", "memory", ""),
         ("memory", "project", ""), ("project", "complete", ""), ("complete", "fuse", "next round"),
         ("memory", "out", "")],
    ),
    "memory": Diagram(
        {
            "pixel": (0, 0, "data", "pixel: colour,|depth, confidence"),
            "point": (1, 0, "step", "lift to a 3D point|with its spacing"),
            "voxel": (2, 0, "step", "find the voxel"),
            "new": (3, 0, "result", "new direction:|new observation"),
            "merge": (3, 1, "result", "same direction:|weighted mean"),
            "reject": (2, 1, "result", "generated, in known|space: rejected"),
        },
        [("pixel", "point", ""), ("point", "voxel", ""), ("voxel", "new", ""),
         ("voxel", "merge", ""), ("voxel", "reject", "")],
    ),
    "appearance": Diagram(
        {
            "photos": (0, 0.5, "data", "context|photographs"),
            "fit": (1, 0.5, "step", "fit Gaussians,|poses, exposures"),
            "memory": (2, 0, "data", "memory:|the evidence"),
            "gaussians": (2, 1, "data", "Gaussians:|the appearance"),
            "judges": (3, 1.5, "step", "predict photographs|left out at first"),
            "blend": (3, 0.5, "step", "blend colours of|observed pixels"),
            "guidance": (4, 0.5, "result", "colours of the|guidance"),
        },
        [("photos", "fit", ""), ("fit", "memory", ""), ("fit", "gaussians", ""),
         ("memory", "blend", ""), ("gaussians", "blend", ""), ("gaussians", "judges", ""),
         ("judges", "blend", ""), ("blend", "guidance", "")],
    ),
    "projection": Diagram(
        {
            "memory": (0, 0, "data", "observations"),
            "cull": (1, 0, "step", "leave out what the|camera cannot see"),
            "depth": (2, 0, "step", "nearest depth|a pixel"),
            "blend": (3, 0, "step", "blend colours within|a thin depth band"),
            "support": (3, 1, "step", "enough support?"),
            "guidance": (2, 1, "result", "colour, depth, valid,|confidence, generated"),
        },
        [("memory", "cull", ""), ("cull", "depth", ""), ("depth", "blend", ""),
         ("blend", "support", ""), ("support", "guidance", "")],
    ),
    "rounds": Diagram(
        {
            "zero": (0, 0, "step", "round 0: fuse|the context views"),
            "one": (1, 0, "step", "round 1: first|target views"),
            "two": (2, 0, "step", "round 2: next|target views"),
            "end": (3, 0, "result", "metrics, report,|memory.ply"),
            "f0": (0, 1, "data", "round_000/"),
            "f1": (1, 1, "data", "round_001/"),
            "f2": (2, 1, "data", "round_002/"),
        },
        [("zero", "one", ""), ("one", "two", ""), ("two", "end", ""),
         ("zero", "f0", ""), ("one", "f1", ""), ("two", "f2", "")],
    ),
    "completers": Diagram(
        {
            "context": (0, 0, "data", "context:|observed views"),
            "guidance": (0, 1, "data", "guidance:|projected memory"),
            "completer": (1, 0.5, "step", "completer"),
            "completion": (2, 0.5, "data", "colour, depth,|confidence"),
            "align": (3, 0.5, "step", "align the scale|with memory"),
            "fuse": (4, 0.5, "result", "fuse unknown|pixels only"),
        },
        [("context", "completer", ""), ("guidance", "completer", ""),
         ("completer", "completion", ""), ("completion", "align", ""), ("align", "fuse", "")],
    ),
    "depth": Diagram(
        {
            "view": (0, 1, "data", "a context view"),
            "sensor": (1, 0, "step", "recorded by a sensor|or by COLMAP"),
            "sweep": (1, 1, "step", "plane sweep from|photographs"),
            "da3": (1, 2, "step", "Depth Anything 3|(your weights)"),
            "check": (2, 1, "step", "check the scale by|sparse points"),
            "map": (3, 1, "result", "depth and|confidence"),
        },
        [("view", "sensor", ""), ("view", "sweep", ""), ("view", "da3", ""),
         ("sensor", "check", ""), ("sweep", "check", ""), ("da3", "check", ""),
         ("check", "map", "")],
    ),
    "measuring": Diagram(
        {
            "held": (0, 0.5, "data", "held-out|photographs"),
            "made": (0, 1.5, "data", "completed|target views"),
            "split": (1, 1, "step", "split pixels into|observed, generated"),
            "images": (2, 0, "result", "PSNR, SSIM, LPIPS,|depth error"),
            "consistency": (2, 1, "result", "agreement|between views"),
            "poses": (2, 2, "result", "where each picture|really looks from"),
        },
        [("held", "split", ""), ("made", "split", ""), ("split", "images", ""),
         ("split", "consistency", ""), ("split", "poses", "")],
    ),
}  # fmt: skip


def rooms() -> list[list[tuple[str, str]]]:
    """Layers of packages from the top down, each with the first sentence of its docstring.

    A package imports from those below; the layers are the ones that ``make lint`` holds.
    """
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    match = re.search(r'containers = \["gvtools"\]\nlayers = (\[.*?\])', text, re.DOTALL)
    assert match is not None
    inside = ast.literal_eval(match[1])
    found = [[_room(ROOT / "pipelines")], [_room(ROOT / "viz")]]
    for layer in inside:
        folders = [ROOT / "gvtools" / name.strip() for name in re.split("[|:]", layer)]
        found.append([_room(folder) for folder in folders if folder.is_dir()])
    return [layer for layer in found if layer]


def _room(folder: Path) -> tuple[str, str]:
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))) or ""
    name = folder.relative_to(ROOT).as_posix()
    return name, " ".join(re.split(r"(?<=[.])\s", text)[0].split())


def rooms_svg() -> str:
    """The layers as rows of boxes with the packages' names and sentences."""
    layers, width, height, gap = rooms(), 262, 80, 12
    across = max(map(len, layers)) * (width + gap) + gap
    down = len(layers) * (height + gap) + gap
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {across} {down}" width="{across}" '
        f'height="{down}" font-family="sans-serif">',
        f'<rect width="{across}" height="{down}" rx="8" fill="#ffffff"/>',
    ]
    for row, layer in enumerate(layers):
        begin = (across - len(layer) * (width + gap) + gap) / 2
        for column, (name, sentence) in enumerate(layer):
            x, y = begin + column * (width + gap), gap + row * (height + gap)
            kind = "data" if name.startswith("gvtools") else "step"
            parts.append(
                f'<rect x="{x:g}" y="{y}" width="{width}" height="{height}" rx="6" '
                f'fill="{FILLS[kind]}" stroke="#455a64"/>'
            )
            parts.append(_text(x + width / 2, y + 18, name))
            for line, text in enumerate(wrap(sentence, 42)):
                parts.append(_text(x + width / 2, y + 36 + 14 * line, text, size=11))
    return "\n".join([*parts, "</svg>"]) + "\n"
