"""Which way is up in points that nobody is known to have seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

# Scenes are wider than high; lower by so much is no accident.
FLATTER = 0.9
# Percent of the points at each end that may lie far off.
STRAY = 0.5
# Points that surfaces are found among, places where they are looked for, and neighbours of a place.
AMONG, PLACES, NEIGHBOURS = 50_000, 4_000, 16
# At a flat place the neighbours' spread across the surface is below this share of that along it.
FLAT = 0.25
# Floors, tables and ceilings are tilted by less in the frames that scenes come in, and agree this
# well, degrees; a smaller share of all flat places is no floor.
TILTED, AGREEING, ENOUGH = 40.0, 6.0, 0.15


def guessed_up(positions: Float64) -> Float64:
    """(3,) unit vector: what fits some points (P, 3) better, near z or near -y.

    Near each, across the surfaces that are nearly level by it, if there are enough. z if the points
    reach less far that way, else -y, as in the frame of a camera.
    """
    normals = flat_normals(positions)
    z, minus_y = (_levelled(up, normals) for up in np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]))
    ends = np.percentile(positions @ np.stack([z, minus_y], axis=1), (STRAY, 100 - STRAY), axis=0)
    high, deep = np.diff(ends, axis=0)[0]
    return z if high < FLATTER * deep else minus_y


def _levelled(up: Float64, normals: Float64) -> Float64:
    """(3,) unit vector across what of the flat places (Q, 3) lies nearly level; else as it was."""
    aligned = np.where(normals @ up < 0, -1.0, 1.0)[:, None] * normals
    level = aligned[aligned @ up > np.cos(np.radians(TILTED))]
    if len(level) < ENOUGH * len(normals) or not len(level):
        return up
    # Those that most others agree with.
    agree = level @ level.T > np.cos(np.radians(AGREEING))
    most = agree[np.argmax(agree.sum(axis=1))]
    if most.sum() < ENOUGH * len(normals):
        return up
    mean = level[most].mean(axis=0)
    across: Float64 = mean / np.linalg.norm(mean)
    return across


def flat_normals(positions: Float64) -> Float64:
    """(Q, 3) unit vectors across the surface at those of some places where it is flat."""
    from scipy.spatial import cKDTree

    among = positions[:: max(1, len(positions) // AMONG)]
    if len(among) < NEIGHBOURS:
        return np.zeros((0, 3))
    places = among[:: max(1, len(among) // PLACES)]
    _, neighbours = cKDTree(among).query(places, k=NEIGHBOURS)
    around = among[neighbours] - among[neighbours].mean(axis=1, keepdims=True)
    # Ascending: the first direction is across the surface.
    spread, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", around, around))
    flat = spread[:, 0] < FLAT**2 * spread[:, 1]
    normals: Float64 = axes[flat, :, 0]
    return normals
