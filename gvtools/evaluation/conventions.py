"""Conventions that an estimated trajectory seems to have wrong, told by what mends its errors."""

from __future__ import annotations

from itertools import product, starmap

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.cameras import invert_rigid
from gvtools.evaluation.trajectories import PoseErrors, absolute_errors, center_extent
from gvtools.similarity import fit_similarity

Float64 = NDArray[np.float64]

# Fewer poses tell nothing; so many that are exactly one were held.
FEW, HELD = 8, 3
# A reading explains an error where it leaves less than this share of it; errors are worth it from
# this share of the path's extent, and from so many degrees.
EXPLAINED, NOTABLE, TURNED = 0.2, 0.002, 10.0
# Places by which an estimate may be late or early, rows of each path that are compared then, and
# rows at which a clock may jump.
PLACES, ROWS, JUMPS = 60, 500, 60
# Where the path's spread across itself is less than so many errors, the turn of the fit is open.
ACROSS = 10.0


def wrong_conventions(
    reference: ArrayLike, estimate: ArrayLike, *, align: str = "sim3"
) -> tuple[str, ...]:
    """A line for each convention of which another reading would take most of the error away.

    Tried are camera from world, another unit, other places in time, the other order of quaternions
    and other axes of the cameras; and poses that stay exactly one while the reference moves are
    counted.

    Args:
        reference: (N, 4, 4) world_from_cam, scene units.
        estimate: (N, 4, 4), row by row the same cameras.
        align: as of ``absolute_errors``.

    >>> poses = np.tile(np.eye(4), (8, 1, 1))
    >>> poses[:, :3, 3] = np.random.default_rng(0).standard_normal((8, 3))
    >>> wrong_conventions(poses, poses @ np.diag([1, -1, -1, 1]))[0][:52]
    "the estimate's cameras are turned by 180 degrees abo"
    """
    first, second = np.asarray(reference, np.float64), np.asarray(estimate, np.float64)

    def errors(poses: Float64, how: str = align) -> PoseErrors:
        return absolute_errors(first, poses, align=how, refuse_mirrored=False)

    found = errors(second)
    if found.translation is None or found.rotation_deg is None or len(first) < FEW:
        return ()
    notes, left = [], found.translation.rmse
    if left > NOTABLE * found.extent:
        inverted, scaled = errors(invert_rigid(second)).translation, errors(second, "sim3")
        if inverted is not None and inverted.rmse < EXPLAINED * left:
            notes.append(
                "one of both seems to hold camera from world: with the estimate inverted, ATE "
                f"would be {inverted.rmse:.4g} instead of {left:.4g}; expected world from camera"
            )
        elif align == "se3" and scaled.translation and scaled.translation.rmse < EXPLAINED * left:
            notes.append(
                f"another unit: with the estimate times {scaled.scale:.4g}, ATE would be "
                f"{scaled.translation.rmse:.4g} instead of {left:.4g} (--align sim3)"
            )
        elif (moved := _moved_in_time(first, second, align=align))[0] < EXPLAINED * left:
            side = "later" if moved[1] > 0 else "earlier"
            notes.append(
                f"the estimate's poses seem to belong {abs(moved[1])} places {side}: ATE would be "
                f"{moved[0]:.4g} instead of {left:.4g}; clocks that differ (--offset), or frames "
                "that are numbered otherwise"
            )
        elif (jump := _clock_jump(first, second, align=align))[0] < EXPLAINED * left:
            notes.append(
                f"a clock seems to jump near pose {jump[1]} of {len(first)}: the estimate's poses "
                f"belong {jump[2]:+d} places before it and {jump[3]:+d} after; ATE would be "
                f"{jump[0]:.4g} instead of {left:.4g}; correct the time stamps of one part"
            )
    centers = first[:, :3, 3] - first[:, :3, 3].mean(axis=0)
    across = np.linalg.svd(centers, compute_uv=False)[1] / np.sqrt(len(first))
    if found.rotation_deg.rmse > TURNED and left * ACROSS < across:
        notes += _other_turn(first, second, found, align=align)
    _, which, counts = np.unique(
        second.reshape(-1, 16), axis=0, return_inverse=True, return_counts=True
    )
    held = np.flatnonzero(which.reshape(-1) == counts.argmax())
    if len(held) >= HELD and center_extent(first[held]) > NOTABLE * found.extent:
        notes.append(
            f"{len(held)} poses of the estimate are exactly one, though the reference moves: "
            "leave poses out where tracking was lost"
        )
    return tuple(notes)


def _moved_in_time(first: Float64, second: Float64, *, align: str) -> tuple[float, int]:
    """The least ATE of an estimate some places later, or 0 (earlier: below), and how many."""
    still = absolute_errors(first, second, align=align, refuse_mirrored=False).translation
    tried = [(np.inf if still is None else still.rmse, 0)]
    for places in range(1, min(PLACES, len(first) // 3) + 1):
        every = max(1, (len(first) - places) // ROWS)
        for sign, late, early in ((1, first, second), (-1, second, first)):
            pair = late[places::every], early[:-places:every]
            found = absolute_errors(*pair[::sign], align=align, refuse_mirrored=False)
            if found.translation is not None:
                tried.append((found.translation.rmse, sign * places))
    return min(tried)


def _clock_jump(first: Float64, second: Float64, *, align: str) -> tuple[float, int, int, int]:
    """The least ATE with other places from some row on; the row, the places before and after."""
    count, part = len(first), len(first) // 4
    ends = slice(0, part), slice(count - part, count)
    before, after = (_moved_in_time(first[e], second[e], align=align)[1] for e in ends)
    tried = [(np.inf, 0, before, after)]
    for row in (
        np.linspace(part, count - part, JUMPS).astype(int).tolist() if before != after else []
    ):
        own = np.arange(count)
        other = own + np.where(own < row, before, after)
        # Beside the jump there are poses that the other path lacks.
        kept = (np.abs(own - row) > abs(after - before)) & (other >= 0) & (other < count)
        found = absolute_errors(
            first[other[kept]], second[own[kept]], align=align, refuse_mirrored=False
        )
        if found.translation is not None:
            tried.append((found.translation.rmse, row, before, after))
    return min(tried)


def _other_turn(first: Float64, second: Float64, found: PoseErrors, *, align: str) -> list[str]:
    """Lines for rotations that do not agree where the centres do."""
    from scipy.spatial.transform import Rotation

    assert found.rotation_deg is not None
    turned = found.rotation_deg.rmse

    def left(rotations: Rotation, true: Rotation) -> float:
        poses = [first.copy(), second.copy()]
        for each, turns in zip(poses, (true, rotations), strict=True):
            each[:, :3, :3] = turns.as_matrix()
        again = absolute_errors(*poses, align=align, refuse_mirrored=False)
        return np.inf if again.rotation_deg is None else again.rotation_deg.rmse

    true, given = (Rotation.from_matrix(poses[:, :3, :3]) for poses in (first, second))
    fit = fit_similarity(second[:, :3, 3], first[:, :3, 3], with_scale=align == "sim3")
    frame = Rotation.identity() if align == "none" else Rotation.from_matrix(fit.rotation)
    mount = (true.inv() * frame * given).mean()
    if left(given * mount.inv(), true) < EXPLAINED * turned:
        axis = (np.round(mount.as_rotvec() / mount.magnitude(), 2) + 0.0).tolist()
        return [
            f"the estimate's cameras are turned by {np.degrees(mount.magnitude()):.4g} degrees "
            f"about their axis {axis} all along: other axes of the camera (OpenGL's), or another "
            "sensor's poses; figures of rotation, RPE and AUC hold this turn"
        ]
    inverted = min(left(given.inv(), true), left(given, true.inv()))
    if inverted < EXPLAINED * turned:
        return [
            "one file's rotations seem to map the other way (from world to camera, beside centres "
            f"in the world): inverted, they are off by {inverted:.4g} degrees, not {turned:.4g}"
        ]
    estimates, references = (
        [Rotation.from_quat(turns.as_quat()[:, order]) for order in ([1, 2, 3, 0], [3, 0, 1, 2])]
        for turns in (given, true)
    )
    ways = {
        "the estimate's": min(left(other, true) for other in estimates),
        "the reference's": min(left(given, other) for other in references),
        "both files'": min(starmap(left, product(estimates, references))),
    }
    whose, least = min(ways.items(), key=lambda way: way[1])
    if least >= EXPLAINED * turned:
        return []
    # In one frame, the order of either explains the same.
    if max(ways["the estimate's"], ways["the reference's"]) < EXPLAINED * turned:
        whose = "one file's"
    return [
        f"{whose} quaternions seem to be of the other order: with the real part at the other end, "
        f"rotations are off by {least:.4g} degrees instead of {turned:.4g}; name the "
        "columns in a first line ('# timestamp tx ty tz qw qx qy qz')"
    ]
