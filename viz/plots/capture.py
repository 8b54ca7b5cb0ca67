"""The cameras of a capture from above, with the pictures that overlap joined by lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from viz.plots.palette import BLUE, GREY, ORANGE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from gvtools.cameras import Cameras

# Share of the points, nearest to their median, that decides what the figure shows.
SHOWN = 0.9
MOST_POINTS = 20_000


def draw_capture(
    cameras: Cameras,
    points: NDArray[np.float64],
    overlap: Sequence[tuple[str, str, float]],
    *,
    title: str,
) -> Figure:
    """The cameras seen along z, in the world's x and y.

    Args:
        cameras: the registered ones, in the order of their names.
        points: (N, 3) triangulated points.
        overlap: pairs of names with how much they share; other names are left out.
        title: of the figure.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 7), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    centres = cameras.centers[:, :2]
    ahead = cameras.world_from_cam[:, :2, 2]
    row = {name: number for number, name in enumerate(cameras.names)}
    pairs = [(row[a], row[b], count) for a, b, count in overlap if a in row and b in row]
    if pairs:
        most = max(count for _, _, count in pairs)
        lines = [np.stack([centres[a], centres[b]]) for a, b, _ in pairs]
        shade = [(0.6, 0.6, 0.6, 0.1 + 0.7 * count / most) for _, _, count in pairs]
        axes.add_collection(LineCollection(lines, colors=shade, linewidths=0.8, zorder=1))
    if len(points):
        step = max(1, len(points) // MOST_POINTS)
        axes.scatter(
            points[::step, 0],
            points[::step, 1],
            s=0.6,
            color=GREY,
            alpha=0.5,
            linewidths=0,
            zorder=0,
        )
    axes.plot(*centres.T, color=BLUE, linewidth=0.8, alpha=0.6, zorder=2)
    axes.quiver(*centres.T, *ahead.T, color=BLUE, width=0.003, scale=25, zorder=3)
    axes.scatter(
        centres[:1, 0],
        centres[:1, 1],
        color=ORANGE,
        s=30,
        zorder=4,
        label=f"first: {cameras.names[0]}",
    )
    everything = np.concatenate([centres, _near(points[:, :2])]) if len(points) else centres
    # A square about all that is shown, with a margin.
    middle = (everything.min(axis=0) + everything.max(axis=0)) / 2
    half = 0.55 * float(np.ptp(everything, axis=0).max())
    axes.set_xlim(middle[0] - half, middle[0] + half)
    axes.set_ylim(middle[1] - half, middle[1] + half)
    axes.set_aspect("equal")
    axes.set_xlabel("x")
    axes.set_ylabel("y")
    axes.set_title(title)
    axes.legend(loc="upper right", frameon=False, fontsize="small")
    return figure


def _near(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The SHOWN share of points that lie nearest to their median."""
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return points[distance <= np.quantile(distance, SHOWN)]
