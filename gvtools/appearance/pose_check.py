"""Whether poses fit recorded depth: each photograph is predicted from its neighbours'."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from kornia.filters import gaussian_blur2d
from numpy.typing import NDArray

from gvtools.appearance.fit_views import FitView, ReducedView, reduced

# Photographs are compared at one over this of their size, each with so many neighbours, by one of
# so many pixels.
SMALLER, NEIGHBOURS, PIXELS = 2, 2, 4
# With fewer of these inside, a pair does not count.
FEWEST = 25


def compared(views: Sequence[FitView]) -> list[ReducedView]:
    """Views as ``prediction_error`` compares them: smaller, without their noise."""
    return [_blurred(reduced(view, SMALLER)) for view in views]


def prediction_error(
    small: Sequence[ReducedView],
    poses: NDArray[np.float64],
    *,
    at: NDArray[np.float64] | None = None,
) -> float:
    """Mean over pairs of neighbouring photographs of the median colour difference, 0 to 1.

    Each pixel with depth is looked up in the neighbour; what is hidden there is a minority that the
    median passes over. NaN where no pair overlaps.

    Args:
        small: at least two, with depth; see ``compared``.
        poses: (V, 4, 4) of the cameras, in the frame of the views.
        at: (V, 4, 4) where each camera is when it is compared with the others; None: at its pose.
    """
    at = poses if at is None else at
    centers = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    depths = np.concatenate([view.depth.ravel() for view in small if view.depth is not None])
    known = depths[depths > 0]
    typical = float(np.median(known)) if len(known) else 1.0
    errors = []
    for row, view in enumerate(small):
        assert view.depth is not None
        apart = (
            np.linalg.norm(centers - centers[row], axis=1) / typical
            + 1
            - poses[:, 2, :3] @ poses[row, 2, :3]
        )
        apart[row] = np.inf
        for other in np.argsort(apart, kind="stable")[: min(NEIGHBOURS, len(small) - 1)]:
            y, x = (each[::PIXELS] for each in np.nonzero((view.depth > 0) & (view.weight > 0.5)))
            rays = np.stack([x + 0.5, y + 0.5, np.ones(len(x))]).T @ np.linalg.inv(view.K).T
            points = rays * view.depth[y, x, None]
            motion = poses[other] @ np.linalg.inv(at[row])
            points = points @ motion[:3, :3].T + motion[:3, 3]
            found, inside = _looked_up(small[other].target, points, small[other].K)
            if inside.sum() > FEWEST:
                errors.append(float(np.median(np.abs(found - view.target[:, y, x])[:, inside])))
    return float(np.mean(errors)) if errors else float("nan")


def _blurred(view: ReducedView) -> ReducedView:
    """Without its noise, which looking up between pixels would average away.

    Else poses seemed better that make pictures meet between pixels.
    """
    smooth = gaussian_blur2d(torch.from_numpy(view.target)[None], (5, 5), (1.0, 1.0))
    return replace(view, target=smooth[0].numpy())


def _looked_up(
    picture: NDArray[np.float32], points: NDArray[np.float64], K: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Colours (3, N) of a picture at points of its camera's frame, and which lie inside."""
    height, width = picture.shape[1:]
    ahead = points[:, 2] > 0
    xy = points @ K.T
    xy = xy[:, :2] / np.where(ahead, xy[:, 2], 1)[:, None]
    inside = ahead & (xy > 0).all(axis=1) & (xy < [width, height]).all(axis=1)
    grid = torch.from_numpy((xy / [width, height] * 2 - 1).astype(np.float32))[None, None]
    colors = torch.nn.functional.grid_sample(
        torch.from_numpy(picture)[None], grid, padding_mode="border", align_corners=False
    )
    return colors[0, :, 0].numpy(), inside
