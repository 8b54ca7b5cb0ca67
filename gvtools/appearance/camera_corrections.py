"""Corrections of cameras that are fitted along: small motions of poses, and exposures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.gaussians import Gaussians
from gvtools.cameras import Cameras
from gvtools.poses.motions import mean_near, move_pose
from gvtools.splats import LOG_SCALE, SH, harmonics

# Each component of a pose's correction stays below this angle [rad] and share of the typical depth.
MOST_TURN, MOST_SHIFT = 0.035, 0.03
# Step lengths: of turns [rad], of shifts in shares of the depth, of the logarithm of exposures.
# Those of poses are at the end smaller by the last number, so that right poses come to rest.
TURN_RATE, SHIFT_RATE, GAIN_RATE, RATE_END = 1e-3, 1e-3, 6e-3, 0.02
# A camera's exposure is predicted from the COUNT photographs nearest to it, weighted by
# exp(-(distance / (SHIFT typical depths) + angle between viewing directions [rad] / TURN)).
COUNT, SHIFT, TURN = 4, 0.2, 0.3
# Weight of a change of harmonics of 1 beside errors of 1 in one camera. On `fox_colmap` 0.1 loses
# 0.2 dB to pictures with each camera's exposure, 1 loses 0.3 dB, no change 1.4 dB.
RIDGE = 0.1


class CameraCorrections:
    """Pose and exposure of each view, as corrected so far.

    The corrections of all views have mean zero, so that the scene as a whole stays where it is.
    """

    def __init__(
        self, poses: NDArray[np.float64], *, depth: float, with_poses: bool, exposure: bool
    ) -> None:
        # ``depth`` is a typical one, scene units; ``spread``: whether cameras that are not fitted
        # take the mean correction of the views near them.
        self.given, self.depth, self.spread = poses, depth, False
        self.with_poses, self.exposure = with_poses, exposure
        count = len(poses)
        # In se(3), shift (in shares of the depth), then turn [rad]; multiplied from the left:
        # exp(twist) cam_from_local. Logarithms of the brightness of red, green and blue.
        self.twists, self.log_gains = np.zeros((count, 6)), np.zeros((count, 3))
        self._pose_moments = np.zeros((2, count, 6))
        self._gain_moments = np.zeros((2, count, 3))
        self._pose_steps, self._gain_steps = np.zeros(count, int), np.zeros(count, int)

    def pose(self, number: int) -> NDArray[np.float64]:
        """(4, 4) the corrected pose of a view."""
        if not self.with_poses:
            return self.given[number]
        return move_pose(self.given[number], self._motion(number))

    def _motion(self, number: int) -> NDArray[np.float64]:
        twist = self.twists[number] - self.twists.mean(axis=0)
        return twist * np.repeat([self.depth, 1.0], 3)

    def poses(self) -> NDArray[np.float64]:
        """(V, 4, 4) all corrected poses."""
        return np.stack([self.pose(number) for number in range(len(self.given))])

    def corrected(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """(4, 4) another camera's pose, moved as the views near it were moved if ``spread``."""
        return move_pose(pose, self._motion_near(pose)) if self.spread else pose

    def like_neighbours(self, number: int, *, but: Sequence[int]) -> NDArray[np.float64]:
        """(4, 4) a view's given pose, moved as the views near it; the views ``but`` do not count.

        A tracker's error that changes slowly along its path moves cameras near each other alike.
        """
        return move_pose(self.given[number], self._motion_near(self.given[number], but=but))

    def start_like_neighbours(self, numbers: Sequence[int]) -> None:
        """Correct views that were not fitted so far as those near them, if ``spread``."""
        if self.spread:
            unit = np.repeat([self.depth, 1.0], 3)
            near = [self._motion_near(self.given[row], but=numbers) / unit for row in numbers]
            self.twists[list(numbers)] = np.array(near) + self.twists.mean(axis=0)

    def _motion_near(
        self, pose: NDArray[np.float64], *, but: Sequence[int] = ()
    ) -> NDArray[np.float64]:
        """(6,) mean motion of the views that stand and look most like a pose."""
        motions = np.stack([self._motion(row) for row in range(len(self.given))])
        return mean_near(pose, self.given, motions, depth=self.depth, but=but)

    def give_back(self) -> None:
        """Take the poses as they were given, from now on."""
        self.twists[:] = 0
        self.with_poses = self.spread = False

    def summary(self) -> str:
        """How far poses were moved, in words."""
        motions = np.stack([self._motion(number) for number in range(len(self.given))])
        shift = np.median(np.linalg.norm(motions[:, :3], axis=1))
        turn = np.degrees(np.median(np.linalg.norm(motions[:, 3:], axis=1)))
        return f"poses moved by {shift:.3g} scene units and {turn:.2f} degrees (medians)"

    def gain(self, number: int) -> NDArray[np.float32]:
        """(3,) what a view's red, green and blue are multiplied by."""
        return np.exp(self.log_gains[number] - self.log_gains.mean(axis=0)).astype(np.float32)

    def step(self, number: int, d_camera: NDArray[np.float32], *, share: float) -> None:
        """Move a view's pose against the gradient (12,) by its rotation and translation."""
        if not self.with_poses:
            return
        pose = self.pose(number)
        d_rotation, d_translation = d_camera[:9].reshape(3, 3).astype(float), d_camera[9:]
        # A turn w about the camera's axes changes R by w x R and t by w x t.
        moments = d_rotation @ pose[:3, :3].T + np.outer(d_translation, pose[:3, 3])
        turn = [moments[2, 1] - moments[1, 2], moments[0, 2] - moments[2, 0],
                moments[1, 0] - moments[0, 1]]  # fmt: skip
        gradient = np.concatenate([d_translation * self.depth, turn])
        self._pose_steps[number] += 1
        rate = np.repeat([SHIFT_RATE, TURN_RATE], 3) * RATE_END**share
        self.twists[number] -= rate * _adam(
            self._pose_moments[:, number], gradient, self._pose_steps[number]
        )
        limit = np.repeat([MOST_SHIFT, MOST_TURN], 3)
        self.twists[number] = np.clip(self.twists[number], -limit, limit)

    def step_gain(self, number: int, gradient: NDArray[np.float32]) -> None:
        """Change a view's exposure against the gradient (3,) by its logarithm."""
        if not self.exposure:
            return
        self._gain_steps[number] += 1
        self.log_gains[number] -= GAIN_RATE * _adam(
            self._gain_moments[:, number], gradient, self._gain_steps[number]
        )


def _adam(moments: NDArray, gradient: NDArray, step: int) -> NDArray[np.float64]:
    """The direction of a step of Adam; ``moments`` (2, ...) are updated."""
    moments[0] += 0.1 * (gradient - moments[0])
    moments[1] += 0.001 * (np.square(gradient) - moments[1])
    mean, square = moments[0] / (1 - 0.9**step), moments[1] / (1 - 0.999**step)
    return mean / (np.sqrt(square) + 1e-15)


@dataclass(frozen=True, eq=False)
class Exposures:
    """Exposures of photographs, from which that of a camera near them is predicted.

    Cameras on automatic expose for what they see, so photographs near each other have similar
    exposures. How far that holds in a scene is found by predicting each photograph's exposure from
    the others'.

    >>> poses = np.tile(np.eye(4), (9, 1, 1))
    >>> poses[:, 0, 3] = places = np.linspace(0, 1, 9)
    >>> rising = Exposures(poses, np.outer(places - 0.5, [0.2, 0.2, 0.2]), depth=1.0)
    >>> dark, bright = rising.at(poses[0]), rising.at(poses[8])
    >>> bool(dark[0] < 1 < bright[0])
    True
    """

    poses: NDArray[np.float64]  # (V, 4, 4) cam_from_local, in the Gaussians' own frame
    # (V, 3) natural logarithms of the factors of red, green and blue, with mean zero.
    log_gains: NDArray[np.float64]
    depth: float  # typical depth, scene units

    @cached_property
    def shrinkage(self) -> float:
        """Regression slope of the log gains on those predicted from the other photographs, 0 to 1.

        At 0 neighbours predict nothing, and new cameras get the mean exposure of all photographs.
        """
        if len(self.poses) < 2:
            return 0.0
        near = np.array([self._near(pose, but=row) for row, pose in enumerate(self.poses)])
        squares = float(np.square(near).sum())
        if not squares > 0:
            return 0.0
        return float(np.clip((near * self.log_gains).sum() / squares, 0, 1))

    def at(self, pose: NDArray[np.float64]) -> NDArray[np.float32]:
        """(3,) factors of red, green and blue for a camera at ``pose``, cam_from_local (4, 4)."""
        if self.shrinkage == 0:
            return np.ones(3, np.float32)
        return np.exp(self.shrinkage * self._near(pose)).astype(np.float32)

    def _near(self, pose: NDArray[np.float64], *, but: int | None = None) -> NDArray[np.float64]:
        return mean_near(
            pose, self.poses, self.log_gains, depth=self.depth,
            but=() if but is None else (but,), count=COUNT, reach=(SHIFT, TURN),
        )  # fmt: skip


def expose(gaussians: Gaussians, exposures: Exposures, cameras: Cameras) -> Gaussians:
    """Gaussians whose colours are, in cameras that see them, as these cameras are exposed.

    Photographs near each other are exposed alike, so most of it depends on the direction that a
    Gaussian is seen from, and that is what spherical harmonics can hold.
    Each Gaussian's harmonics change by the least squares solution over the ``cameras``, such as the
    photographs', whose picture its centre lies in. ``exposures`` are in the Gaussians' frame.
    """
    values = gaussians.values
    sh = values[:, SH:].reshape(len(values), -1, 3).astype(np.float64)
    terms = sh.shape[1]
    normal = np.tile(RIDGE * np.eye(terms), (len(values), 1, 1))
    right = np.zeros_like(sh)
    for camera in cameras:
        pose = gaussians.frame.cam_from_local(camera.cam_from_world)[0]
        points = values[:, :LOG_SCALE].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        x, y, w = (points @ camera.K[0].T).T
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = np.stack([x / w, y / w], axis=1)
        size = np.array([camera.width[0], camera.height[0]])
        seen = np.flatnonzero((points[:, 2] > 0) & ((xy > 0) & (xy < size)).all(axis=1))
        away = points[seen] @ pose[:3, :3]
        basis = harmonics(away / np.linalg.norm(away, axis=1, keepdims=True), 2)
        colors = np.maximum(0.5 + np.einsum("nh,nhc->nc", basis, sh[seen]), 0)
        change = (exposures.at(pose) - 1) * colors
        normal[seen] += basis[:, :, None] * basis[:, None]
        right[seen] += basis[:, :, None] * change[:, None]
    out = values.copy()
    out[:, SH:] = (sh + np.linalg.solve(normal, right)).reshape(len(values), -1)
    return Gaussians(out, frame=gaussians.frame)
