"""Figures of cameras: of a run from above and from the side, and of a capture with its overlaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from viz.plots.canvas import BLACK, BLUE, GREY, LEGEND, LINES, ORANGE, blank_figure, figure_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from gvtools.cameras import Cameras

# Viewing directions are drawn so long, as a share of the cameras' extent, and at most so many.
ARROW = 0.07
MOST_ARROWS = 80
# The mean of the cameras' up directions says nothing where it is shorter.
LEAST_UP = 0.2
# Share of a capture's points, nearest to their median, that decides what its figure shows.
SHOWN = 0.9
MOST_POINTS = 20_000


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Camera-to-world poses in one world frame, scene units, OpenCV axes."""

    context: NDArray[np.float64]  # (C, 4, 4), of the views that were given
    requested: NDArray[np.float64]  # (T, 4, 4), of the targets, in their order
    # (T, 4, 4), where the completed pictures look from, NaN where that was not found; None where
    # nobody looked for it.
    estimated: NDArray[np.float64] | None = None

    @property
    def located(self) -> NDArray[np.bool_]:
        """(T,) which of the targets have an estimated pose."""
        if self.estimated is None:
            return np.zeros(len(self.requested), np.bool_)
        return np.asarray(np.isfinite(self.estimated).all(axis=(1, 2)))


def draw_trajectories(
    poses: Trajectories, *, title: str | None = None, panels: Sequence[str] | None = None
) -> Figure:
    """From above ("top") and from the side ("side"), in scene units around the cameras' mean.

    Up is the mean of the context cameras' up directions (of the targets' without context); where
    they cancel out, the direction in which the cameras spread least. The horizontal axis is the
    one along which they spread most.
    """
    axes = principal_axes(np.concatenate([poses.context, poses.requested]), poses.context)
    known = {
        "top": partial(_poses_panel, poses=poses, plane=axes[[0, 1]], names=("right", "forward")),
        "side": partial(_poses_panel, poses=poses, plane=axes[[0, 2]], names=("right", "up")),
    }
    return figure_of([known[name] for name in panels or known], title=title)


def principal_axes(
    world_from_cam: NDArray[np.float64], upright: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(3, 3) orthonormal rows right, forward, up of a right-handed frame, in world coordinates.

    Args:
        world_from_cam: (N, 4, 4) poses; along "right" their centres spread most.
        upright: (M, 4, 4) poses whose mean up direction is up; those of ``world_from_cam`` where
            there are none.
    """
    centres = world_from_cam[:, :3, 3] - world_from_cam[:, :3, 3].mean(axis=0)
    spread = np.linalg.svd(centres)[2]
    # A camera's y axis points down.
    up = -(upright if len(upright) else world_from_cam)[:, :3, 1].mean(axis=0)
    up = spread[2] if np.linalg.norm(up) < LEAST_UP else up / np.linalg.norm(up)
    flat = centres - np.outer(centres @ up, up)
    right = np.linalg.svd(flat)[2][0]
    if np.abs(flat).max() < 1e-9 * max(1.0, float(np.abs(centres).max())):
        right = world_from_cam[0, :3, 0]
    right = right - (right @ up) * up
    length = np.linalg.norm(right)
    right = right / length if length > 1e-9 else np.linalg.svd(up[None])[2][1]
    # Of the two directions the one in which the cameras' own right points.
    if right @ world_from_cam[:, :3, 0].mean(axis=0) < 0:
        right = -right
    return np.stack([right, np.cross(up, right), up])


def _poses_panel(
    axes: Axes,
    *,
    poses: Trajectories,
    plane: NDArray[np.float64],
    names: tuple[str, str],
) -> None:
    everything = np.concatenate([poses.context, poses.requested])[:, :3, 3]
    middle = everything.mean(axis=0)
    extent = float(np.ptp(everything, axis=0).max()) or 1.0

    def flat(world_from_cam: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        place = (world_from_cam[:, :3, 3] - middle) @ plane.T
        look = world_from_cam[:, :3, 2] @ plane.T
        return place, look

    def arrows(world_from_cam: NDArray[np.float64], color: str) -> None:
        place, look = flat(world_from_cam[:: max(1, -(-len(world_from_cam) // MOST_ARROWS))])
        ends = place + ARROW * extent * look
        axes.plot(*np.stack([place, ends]).transpose(2, 0, 1), color=color, linewidth=0.8)

    if len(poses.context):
        arrows(poses.context, BLUE)
        place, _ = flat(poses.context)
        axes.scatter(
            place[:, 0], place[:, 1], s=16, color=BLUE, label=f"context ({len(place)})", zorder=3
        )
    if len(poses.requested):
        arrows(poses.requested, ORANGE)
        place, _ = flat(poses.requested)
        axes.plot(*place.T, color=ORANGE, linewidth=0.6, alpha=0.6)
        axes.scatter(
            place[:, 0], place[:, 1], s=34, marker="s", facecolor="none", edgecolor=ORANGE,
            linewidth=1.6, label=f"requested ({len(place)})", zorder=4,
        )  # fmt: skip
    if poses.estimated is not None:
        rows = poses.located
        there, _ = flat(poses.estimated[rows])
        here, _ = flat(poses.requested[rows])
        axes.plot(*np.stack([here, there]).transpose(2, 0, 1), color=GREY, linewidth=1, zorder=5)
        axes.scatter(
            there[:, 0], there[:, 1], s=26, marker="x", color=BLACK, linewidth=1.2, zorder=6,
            label=f"estimated ({int(rows.sum())} of {len(rows)} located)",
        )  # fmt: skip
    axes.set_title("from above" if names[1] == "forward" else "from the side")
    axes.set_xlabel(f"{names[0]}, scene units")
    axes.set_ylabel(f"{names[1]}, scene units")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08, 0.14)
    axes.grid(**LINES)
    axes.legend(
        ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.08), handletextpad=0.3,
        columnspacing=1.0, **LEGEND,
    )  # fmt: skip


def draw_capture(
    cameras: Cameras,
    points: NDArray[np.float64],
    overlap: Sequence[tuple[str, str, float]],
    *,
    title: str,
) -> Figure:
    """A capture's cameras and (N, 3) triangulated points along z, in the world's x and y.

    Lines join pictures that overlap, the more the darker; names without a camera are left out.
    """
    from matplotlib.collections import LineCollection

    figure = blank_figure((8, 7), dpi=110)
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
        x, y = points[::step, :2].T
        axes.scatter(x, y, s=0.6, color=GREY, alpha=0.5, linewidths=0, zorder=0)
    axes.plot(*centres.T, color=BLUE, linewidth=0.8, alpha=0.6, zorder=2)
    axes.quiver(*centres.T, *ahead.T, color=BLUE, width=0.003, scale=25, zorder=3)
    label = f"first: {cameras.names[0]}"
    axes.scatter(centres[0, 0], centres[0, 1], color=ORANGE, s=30, zorder=4, label=label)
    everything = centres
    if len(points):
        flat = points[:, :2]
        distance = np.linalg.norm(flat - np.median(flat, axis=0), axis=1)
        near = flat[distance <= np.quantile(distance, SHOWN)]
        everything = np.concatenate([centres, near])
    # A square about all that is shown, with a margin.
    middle = (everything.min(axis=0) + everything.max(axis=0)) / 2
    half = 0.55 * float(np.ptp(everything, axis=0).max())
    axes.set_xlim(middle[0] - half, middle[0] + half)
    axes.set_ylim(middle[1] - half, middle[1] + half)
    axes.set_aspect("equal")
    axes.set_xlabel("x")
    axes.set_ylabel("y")
    axes.set_title(title)
    axes.legend(loc="upper right", **LEGEND)
    return figure
