"""A placed scan as observations of a memory."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, rigid_poses
from gvtools.memory.spatial_memory import FuseReport, SpatialMemory
from gvtools.memory.store.views import PointSet
from gvtools.scans.points import Scan
from gvtools.scans.registration import Placement

# Density around a point is computed from so many nearest neighbours.
NEIGHBOURS = 8
# A point whose neighbours are so many times farther away than those of its neighbours is isolated:
# dust, or a mixed pixel at a depth edge.
ISOLATED = 4.0
# A scan's views are named PREFIX/FILE/STATION.
PREFIX = "scan"


def fuse_scan(
    memory: SpatialMemory, scan: Scan, placement: Placement, *, round: int = 0
) -> FuseReport:
    """Fuse a scan's points, station by station; they are ``scanned``, see ``SpatialMemory.fuse``.

    A point's spacing is the distance between its neighbours; it decides the point's voxel and the
    size of its splat.
    """
    # Relative to both origins: georeferenced coordinates are too large for float32.
    turn = placement.world_from_scan[:3, :3]
    local = memory.frame.from_world(scan.positions @ turn.T + placement.apply(scan.origin))
    spacing, isolated = point_spacing(local)
    total = FuseReport()
    for row, station in enumerate(scan.stations):
        mine = scan.station == row
        rows = np.flatnonzero(mine & ~isolated)
        dropped = {"isolated": int((mine & isolated).sum())} if (mine & isolated).any() else {}
        if not len(rows):
            total = replace(total, dropped=dict(Counter(total.dropped) + Counter(dropped)))
            continue
        if station.center is None:
            center = memory.frame.to_world(local[rows].mean(axis=0)[None])[0]
        else:
            center = placement.apply(np.array(station.center))
        # A camera of one pixel, since a view needs one.
        pose, name = rigid_poses(np.eye(3), -center), f"{PREFIX}/{scan.name}/{station.name}"
        camera = Cameras.alike(np.eye(3), pose, size=(1, 1), names=(name,))
        points = PointSet(
            local[rows].astype(np.float32), scan.colors[rows],
            np.ones(len(rows), np.float32), spacing[rows].astype(np.float32),
            camera, memory.frame, None, {},
        )  # fmt: skip
        report = memory.fuse(points, round=round, scanned=True)
        total += replace(report, dropped=dropped)
    return total


def point_spacing(positions: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The spacing of points (N, 3) on a surface, from the density around each, and isolated ones.

    With the k-th neighbour at a distance r the spacing is r sqrt(pi / (k - 1)).

    >>> grid = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), -1).reshape(-1, 3)
    >>> round(float(np.median(point_spacing(grid)[0])), 1)
    0.9
    """
    from scipy.spatial import KDTree

    count = min(NEIGHBOURS, len(positions) - 1)
    if count < 1:
        return np.ones(len(positions)), np.zeros(len(positions), np.bool_)
    away, rows = KDTree(positions).query(positions, count + 1, workers=-1)
    radius = away[:, count]
    # k - 1, since the k-th neighbour lies on the border of the disc: unbiased for random points.
    spacing = radius * np.sqrt(np.pi / max(count - 1, 1))
    around = np.median(radius[rows[:, 1:]], axis=1)
    isolated = radius > ISOLATED * around
    positive = spacing[spacing > 0]
    least = float(positive.min()) if positive.size else 1.0
    return np.maximum(spacing, least), isolated
