"""Which photographs a pass looks at: those that see what its targets show, or the nearest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, concatenate
from gvtools.completers.base import ContextView
from gvtools.view_selection import covisible_views, nearest_views


def chosen_views(
    context: Sequence[ContextView],
    targets: Cameras,
    depth: NDArray[np.float32],
    *,
    count: int,
    selection: str,
) -> list[ContextView]:
    """At most ``count`` context views, the best first.

    Args:
        context: to choose from.
        targets: V cameras of one picture size.
        depth: (V, H, W) z-depth of the targets, scene units, filled where that is possible.
        count: how many at most.
        selection: "covisible" or "nearest", see ``gvtools.view_selection``.
    """
    if not context:
        return []
    cameras = concatenate([view.camera for view in context])
    if selection == "covisible":
        depths = [view.depth for view in context]
        rows = covisible_views(cameras, targets, depth, count=count, depths=depths)
    else:
        rows = nearest_views(cameras, targets, count)
    return [context[row] for row in rows]
