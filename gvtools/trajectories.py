"""Target paths as cameras: interpolation between key cameras, orbit and spiral.

World frames are arbitrary, so "up" is never taken from an axis: it is the mean of the given
cameras' own up vectors (−y of each), which keeps a path free of roll jitter.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from gvtools.cameras import Cameras, Float64, invert_rigid, rigid_poses
from gvtools.errors import DegenerateError, OptionError

PATHS = ("orbit", "spiral", "interpolate")
# Centres nearer than this share of their coordinates' magnitude differ by rounding alone.
ROUNDING = 1e-13
# A step below this share of the others is none.
STEP = 1e-9
# Of a camera about its axis, by which it counts half for the vertical (sine); how often this is
# weighed; and what the mean of the up vectors counts beside the spread of the x axes.
ROLL, ROLL_ROUNDS, MEAN_SHARE = 0.2, 5, 0.005
# Revolutions of a spiral, and its share of the captured extent.
TURNS, SPREAD = 2.0, 0.8


def interpolate(cameras: Cameras, count: int) -> Cameras:
    """A smooth path through key cameras, evenly spaced by a measure of motion.

    Centres follow a monotone cubic (PCHIP) of the path length, so the path is C1 and does not
    overshoot; rotations are interpolated on the sphere between consecutive keys; intrinsics
    linearly; the image size is the nearest key's. Each step measures the motion of the centre
    plus the rotation times the median distance between keys, so a camera that turns on the spot
    still moves along. Every key lies on the path; the first and the last are among the result.

    Args:
        cameras: at least two key cameras, in order.
        count: number of cameras on the path, >= 2.
    """
    from scipy.interpolate import PchipInterpolator
    from scipy.spatial.transform import Rotation, Slerp

    _check_counts("interpolate", cameras, count, given=2, asked=2)
    world = cameras.world_from_cam
    rotation = Rotation.from_matrix(world[:, :3, :3])
    steps = _steps(world[:, :3, 3], (rotation[:-1].inv() * rotation[1:]).magnitude())
    keep = np.concatenate([[True], steps > 0])
    if keep.sum() < 2:
        raise DegenerateError("interpolate: all key cameras are the same; give cameras that differ")
    index = np.flatnonzero(keep)
    length = np.concatenate([[0.0], np.cumsum(steps)])[keep]
    at = np.linspace(0, length[-1], count)
    # PCHIP has no cross-talk between coordinates: centred first for large offsets.
    origin = world[0, :3, 3]
    centers = PchipInterpolator(length, world[keep, :3, 3] - origin)(at) + origin
    pose = rigid_poses(Slerp(length, rotation[keep])(at).as_matrix(), centers)
    segment = np.clip(np.searchsorted(length, at, side="right") - 1, 0, len(length) - 2)
    share = (at - length[segment]) / (length[segment + 1] - length[segment])
    K = cameras.K[index]
    blend = share[:, None, None]
    nearest = index[segment + (share > 0.5)]
    return Cameras(
        (1 - blend) * K[segment] + blend * K[segment + 1],
        invert_rigid(pose),
        cameras.width[nearest],
        cameras.height[nearest],
        (),
    )


def _check_counts(what: str, cameras: Cameras, count: int, *, given: int, asked: int) -> None:
    if len(cameras) < given or count < asked:
        raise OptionError(
            f"{what}: {len(cameras)} camera(s) given, {count} asked for; expected {given} or more, "
            f"and {asked} or more"
        )


def _steps(centers: Float64, turned: Float64) -> Float64:
    """(V - 1,) motion between keys: distance, and angle times the median distance."""
    moved = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    real = moved > max(STEP * moved.max(), ROUNDING * np.abs(centers).max())
    unit = float(np.median(moved[real])) if real.any() else 1.0
    steps = moved + unit * turned
    # Keys that repeat their predecessor would give the spline two values at one place.
    steps[steps <= STEP * steps.sum()] = 0
    return steps


def focus_point(cameras: Cameras) -> Float64:
    """(3,) the world point nearest to all optical axes, by least squares."""
    world = cameras.world_from_cam
    origin = cameras.centers.mean(axis=0)
    axes, centers = world[:, :3, 2], world[:, :3, 3] - origin
    # Σ (I − a aᵀ)(x − c) = 0.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(axis=0)
    spread = np.linalg.eigvalsh(normal / len(axes))
    if spread[0] < 1e-8:
        raise DegenerateError(
            "focus point: the optical axes are parallel, no point is nearest to them; "
            "give the point with center="
        )
    return np.asarray(np.linalg.solve(normal, np.einsum("vij,vj->i", across, centers)) + origin)


def mean_up(cameras: Cameras) -> Float64:
    """(3,) unit, the mean of the cameras' up vectors (−y) in the world frame."""
    up = -cameras.world_from_cam[:, :3, 1].mean(axis=0)
    norm = float(np.linalg.norm(up))
    if norm < 1e-3:
        raise DegenerateError("the cameras' up vectors cancel out; give up=")
    return np.asarray(up / norm)


def level_up(cameras: Cameras) -> Float64:
    """(3,) unit, the vertical in the world frame: most nearly across all cameras' x axes.

    Cameras are held level more than they are held straight: where all look down, the mean of their
    up vectors leans (25 degrees in the kitchen of 7-Scenes, this 1.3). Where all look one way, that
    mean decides how much. Cameras that lie on their side count little.
    """
    try:
        mean = mean_up(cameras)
    except DegenerateError:
        # As from a drone that looks straight down while it turns.
        mean = -cameras.world_from_cam[:, :3, 2].mean(axis=0)
    across, up = cameras.world_from_cam[:, :3, 0], mean
    for _ in range(ROLL_ROUNDS):
        weight = 1 / (1 + np.square(across @ up / ROLL))
        spread = (across * weight[:, None]).T @ across / weight.sum()
        up = np.linalg.eigh(spread - MEAN_SHARE * np.outer(mean, mean))[1][:, 0]
        up = up * np.sign(up @ mean)
    return up


def look_at(centers: ArrayLike, target: ArrayLike, *, up: ArrayLike) -> Float64:
    """World-from-camera poses that look at a point, with their x axis across ``up``.

    Args:
        centers: (V, 3), world frame.
        target: (3,) or (V, 3), world frame; it appears on the optical axis.
        up: (3,), world frame, of any length.

    Returns:
        (V, 4, 4) float64.
    """
    centers, target = np.asarray(centers, np.float64), np.asarray(target, np.float64)
    axis = np.asarray(up, np.float64)
    if not np.linalg.norm(axis) > 0:
        raise OptionError(f"up {axis.tolist()}; expected three numbers, not all 0")
    axis = axis / np.linalg.norm(axis)
    magnitude = float(np.abs(np.concatenate([centers.ravel(), target.ravel()])).max())
    forward = target - centers
    distance = np.linalg.norm(forward, axis=1, keepdims=True)
    if (distance <= 1e-12 * magnitude).any():
        raise DegenerateError("look at: a camera centre lies on the point that it looks at")
    forward = forward / distance
    right = np.cross(forward, axis)
    norm = np.linalg.norm(right, axis=1, keepdims=True)
    if (norm < 1e-6).any():
        raise DegenerateError("look at: a camera looks along the up vector; choose another up")
    right /= norm
    return rigid_poses(np.stack([right, np.cross(forward, right), forward], axis=2), centers)


def orbit(cameras: Cameras, count: int, *, center: ArrayLike | None = None) -> Cameras:
    """Cameras on a circle that look at its middle.

    It starts at the direction of the first camera and turns counter-clockwise as seen from above;
    the start is not repeated. Radius and height are the cameras' medians.

    Args:
        cameras: where the scene was seen from; intrinsics and size are those of the first.
        count: number of cameras, >= 1.
        center: (3,) what to look at; None means ``focus_point``.
    """
    _check_counts("orbit", cameras, count, given=1, asked=1)
    middle = focus_point(cameras) if center is None else np.asarray(center, np.float64)
    axis = mean_up(cameras)
    offset = cameras.centers - middle
    above = offset @ axis
    flat = offset - above[:, None] * axis
    distance = np.linalg.norm(flat, axis=1)
    if distance[0] <= 1e-9 * float(np.abs(offset).max()):
        raise DegenerateError("orbit: the first camera stands on the axis; give another center=")
    first = flat[0] / distance[0]
    side = np.cross(axis, first)
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)[:, None]
    around = np.cos(angle) * first + np.sin(angle) * side
    centers = middle + np.median(distance) * around + np.median(above) * axis
    return _like_first(cameras, look_at(centers, middle, up=axis))


def spiral(cameras: Cameras, count: int) -> Cameras:
    """A spiral about the mean camera of a forward-facing capture (as LLFF shows its scenes).

    The offset along each axis of the mean camera stays within SPREAD of the cameras' own extent
    there (their 90th percentile), and every camera looks at one point in front: at the distance of
    ``focus_point``, or ten times the extent where the axes are parallel or diverge.

    Args:
        cameras: a forward-facing capture, at least two; intrinsics and size are the first's.
        count: number of cameras, >= 1; the end meets the start after TURNS revolutions.
    """
    _check_counts("spiral", cameras, count, given=2, asked=1)
    middle = cameras.centers.mean(axis=0)
    forward = cameras.world_from_cam[:, :3, 2].mean(axis=0)
    if np.linalg.norm(forward) < 1e-3:
        raise DegenerateError("spiral: the viewing directions cancel out; use orbit instead")
    forward /= np.linalg.norm(forward)
    up = mean_up(cameras)
    frame = look_at(np.zeros((1, 3)), forward, up=up)[0, :3, :3]
    extent = np.percentile(np.abs((cameras.centers - middle) @ frame), 90, axis=0) * SPREAD
    try:
        focus_distance = float((focus_point(cameras) - middle) @ forward)
    except DegenerateError:
        focus_distance = 0.0
    if focus_distance <= extent[2]:
        focus_distance = 10.0 * float(np.linalg.norm(extent))
    angle = 2 * np.pi * TURNS * np.arange(count) / count
    # The depth swings at half the rate, so that successive turns differ.
    offset = np.stack([np.cos(angle), -np.sin(angle), -np.sin(0.5 * angle)], axis=1) * extent
    pose = look_at(middle + offset @ frame.T, middle + focus_distance * forward, up=up)
    return _like_first(cameras, pose)


def _like_first(cameras: Cameras, world_from_cam: Float64) -> Cameras:
    """Cameras at the given poses, with the intrinsics and the size of the first of ``cameras``."""
    size = int(cameras.width[0]), int(cameras.height[0])
    return Cameras.alike(cameras.K[0], invert_rigid(world_from_cam), size=size)


def named_path(
    name: str, cameras: Cameras, *, count: int, depth: Callable[[], tuple[Cameras, float] | None]
) -> Cameras:
    """One of PATHS; an orbit of parallel views goes around what they look at.

    Args:
        depth: one of these cameras and the median depth that it sees, scene units; asked for only
            where the views have no common focus. None where nothing tells it.
    """
    make = {"interpolate": interpolate, "orbit": orbit, "spiral": spiral}[name]
    try:
        return make(cameras, count)
    except DegenerateError:
        seen = depth() if name == "orbit" else None
        if seen is None:
            raise
        camera, distance = seen
        ahead = camera.world_from_cam[0, :3, 2] * distance
        return orbit(cameras, count, center=cameras.centers.mean(axis=0) + ahead)
