"""Draws docs/images/growth.png: the memory of a demo run after each of its rounds.

    gvtools demo --out runs/demo-room
    python docs/make_growth_picture.py runs/demo-room

Above, the room from the ceiling; below, one of the last target views through a wider lens. What was
observed has its own colours, what a completer added is tinted, what nobody knows is white.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

import gvtools

OUT = Path(__file__).parent / "images" / "growth.png"
TINT = np.array([245, 130, 30])
WIDTH, HEIGHT = 300, 225
CUT = 0.8  # share of the room's height that the view from above keeps
Picture = NDArray[np.uint8]


def from_above(memory: gvtools.SpatialMemory, low: NDArray, high: NDArray) -> Picture:
    """The cloud seen along -z, without the ceiling; ``low`` and ``high`` bound it."""
    cloud = memory.cloud
    points = cloud.point.positions.numpy() + memory.origin
    colors = tinted(cloud.point.colors.numpy(), cloud.point.generated.numpy()[:, 0] > 0)
    scale = min((WIDTH - 1) / (high[0] - low[0]), (HEIGHT - 1) / (high[1] - low[1]))
    keep = (points >= low).all(1) & (points <= high).all(1)
    keep &= points[:, 2] < low[2] + CUT * (high[2] - low[2])
    points, colors = points[keep], colors[keep]
    order = np.argsort(points[:, 2])  # from low to high: the highest point is written last
    x, y, _ = ((points[order] - low) * scale).astype(int).T
    left = (WIDTH - int((high[0] - low[0]) * scale)) // 2
    picture = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    picture[HEIGHT - 1 - y, np.minimum(x + left, WIDTH - 1)] = colors[order]
    return picture


def from_target(memory: gvtools.SpatialMemory, camera: gvtools.Cameras) -> Picture:
    """The memory projected into a camera."""
    guidance = memory.project(camera)
    picture = tinted(np.rint(guidance.rgb[0] * 255), guidance.generated[0])
    picture[~guidance.valid[0]] = 255
    return picture


def tinted(colors: NDArray, generated: NDArray[np.bool_]) -> Picture:
    """Colours (..., 3), those of generated content mixed with the tint."""
    mixed = np.where(generated[..., None], 0.55 * colors + 0.45 * TINT, colors)
    return mixed.astype(np.uint8)


def main(folder: Path) -> None:
    """Draw the picture of a run."""
    memory = gvtools.SpatialMemory.load(folder / "memory.npz")
    scene = gvtools.open_project(folder.with_name(f"{folder.name}-sample"))
    camera = scene.views[-3].camera
    wide = gvtools.Cameras.pinhole(
        WIDTH, HEIGHT, focal=0.5 * WIDTH, cam_from_world=camera.cam_from_world[0]
    )
    positions = memory.cloud.point.positions.numpy() + memory.origin
    low, high = np.quantile(positions, [0.0005, 0.9995], axis=0)
    columns = []
    for number in reversed(memory.rounds):
        count = len(memory)
        title = f"round {number}: {count / 1e6:.2f} M observations"
        columns.append((title, from_above(memory, low, high), from_target(memory, wide)))
        memory.forget(round=number)
    gap, head = 10, 24
    sheet = Image.new(
        "RGB", (len(columns) * (WIDTH + gap) + gap, head + 2 * HEIGHT + 2 * gap), "white"
    )
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=15)
    for place, (title, above, below) in enumerate(reversed(columns)):
        left = gap + place * (WIDTH + gap)
        draw.text((left, 3), title, fill="black", font=font)
        sheet.paste(Image.fromarray(above), (left, head))
        sheet.paste(Image.fromarray(below), (left, head + HEIGHT + gap))
    sheet.quantize(256, dither=Image.Dither.NONE).save(OUT, optimize=True)
    print(f"{OUT}: {OUT.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
