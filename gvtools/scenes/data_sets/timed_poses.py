"""Camera poses at the times of frames, from a trajectory with times of its own."""

from __future__ import annotations

import numpy as np

from gvtools.scenes.data_sets.posed_pictures import Float64


def pose_at(
    time: float, times: Float64, poses: Float64, *, same: float, longest_gap: float
) -> Float64 | None:
    """(4, 4) cam_from_world at a time: a stored pose, or one interpolated between its neighbours.

    The camera's centre is interpolated linearly, its rotation spherically (slerp). None outside of
    the trajectory, and where the neighbours are too far apart in time.

    Args:
        time: of the frame, in any unit.
        times: (N,) of the poses, increasing; at least one. This and what follows in the same unit.
        poses: (N, 4, 4) cam_from_world, rigid.
        same: a pose whose time differs by no more than this is taken as it is.
        longest_gap: longest time between two poses that may be interpolated.
    """
    from scipy.spatial.transform import Rotation, Slerp

    after = int(np.searchsorted(times, time))
    near = [i for i in (after - 1, after) if 0 <= i < len(times)]
    nearest = min(near, key=lambda i: abs(times[i] - time))
    if abs(times[nearest] - time) <= same:
        return np.asarray(poses[nearest], np.float64)
    if len(near) < 2 or times[after] - times[after - 1] > longest_gap:
        return None
    pair = poses[after - 1 : after + 1]
    share = (time - times[after - 1]) / (times[after] - times[after - 1])
    centers = -np.einsum("nji,nj->ni", pair[:, :3, :3], pair[:, :3, 3])
    pose = np.eye(4)
    pose[:3, :3] = Slerp([0, 1], Rotation.from_matrix(pair[:, :3, :3]))(share).as_matrix()
    pose[:3, 3] = -pose[:3, :3] @ (centers[0] + share * (centers[1] - centers[0]))
    return pose
