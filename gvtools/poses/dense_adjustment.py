"""Bundle adjustment on dense motion, for recordings whose poses are off by a few pixels.

Poses from a tracker or from a sensor's fusion leave epipolar errors of several pixels, under which
no window finds its match. With first depth maps, the motion that is left between each reference and
its warped sources tells what is wrong: a part that no depth explains, or on which the sources
disagree, belongs to the poses. Unknown are six numbers for each view and one inverse depth for each
pixel; the latter are eliminated view by view, so time and memory grow linearly with the views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64

# Standard deviation of a measured motion, pixels, and where it counts as an outlier, in deviations.
SPREAD, OUTLIER = 0.25, 3.0
# Neighbouring motions are measured on the same pixels and lean the same way: this many count as
# one.
SHARED = 40.0
LEAST_PIXELS = 150
ROUNDS = 6


@dataclass(frozen=True, eq=False)
class PoseEquations:
    """What one reference view's pictures say about the motion of its S sources relative to it.

    With the motions m (S, 6) (rotation vector and translation, in each source's frame) stacked,
    the least-squares misfit is mᵀ ``system`` m − 2 ``right`` · m, inverse depths eliminated.
    """

    system: Float64
    right: Float64
    # (S,) median motion that no depth explains, pixels; NaN without measurement.
    off: Float64


def pose_equations(
    sources: Cameras,
    reference: Cameras,
    inverse_depth: NDArray[np.float32],
    *,
    motion: NDArray[np.float32],
    weight: NDArray[np.float32],
) -> PoseEquations | None:
    """The equations of one reference view; None where too little motion could be measured.

    Args:
        sources: S cameras of the level on which the motion was measured.
        reference: a batch of one, of that level.
        inverse_depth: (H, W), 1 / scene units.
        motion: (S, H, W, 2), by which each warped source's picture is off, its pixels.
        weight: (S, H, W), 0 where the motion is not determined.
    """
    count = len(sources)
    weights = weight.reshape(count, -1).astype(np.float64)
    rows = np.flatnonzero((weights > 0).sum(0) >= 1)[::2]
    if len(rows) < LEAST_PIXELS:
        return None
    weights = weights[:, rows]
    measured = motion.reshape(count, -1, 2)[:, rows].astype(np.float64)
    w = inverse_depth.reshape(-1)[rows].astype(np.float64)
    width = int(reference.width[0])
    xy = np.stack([rows % width, rows // width], axis=-1).astype(np.float64) + 0.5
    jacobian, along = _derivatives(sources, reference, xy, w=w)
    across = measured[..., 0] * along[..., 1] - measured[..., 1] * along[..., 0]
    across /= np.linalg.norm(along, axis=-1) + 1e-12
    off = np.full(count, np.nan)
    for s in range(count):
        if (weights[s] > 0).any():
            off[s] = np.median(np.abs(across[s, weights[s] > 0]))
    system, right = _eliminate_depths(jacobian, along, measured, weight=weights)
    return PoseEquations(system, right, off)


def adjust_cameras(
    cameras: Cameras,
    equations: Sequence[tuple[int, Sequence[int], PoseEquations]],
    *,
    rotation: float,
    translation: float,
) -> Cameras:
    """All cameras with their poses adjusted together.

    What the pictures do not tell, the scale of the scene above all, stays as the poses have it:
    each pose is held to where it was, by the expected errors ``rotation`` [rad] and ``translation``
    [scene units]. ``equations``: for each reference view its row, its sources' rows and what was
    measured.
    """
    count = len(cameras)
    system, right = np.zeros((6 * count, 6 * count)), np.zeros(6 * count)
    prior = np.array([rotation] * 3 + [translation] * 3)
    system[np.diag_indices(6 * count)] = np.tile(1 / prior**2, count)
    for view, others, measured in equations:
        # A source's motion relative to the reference: its own less the reference's, carried over.
        relative = cameras.cam_from_world[list(others)] @ cameras.world_from_cam[view]
        lift = np.zeros((6 * len(others), 6 * (len(others) + 1)))
        for i, pose in enumerate(relative):
            lift[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = np.eye(6)
            # A motion in the reference's frame as one in the source's: the adjoint.
            rotation, (x, y, z) = pose[:3, :3], pose[:3, 3]
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            lift[6 * i : 6 * i + 3, -6:-3] = lift[6 * i + 3 : 6 * i + 6, -3:] = -rotation
            lift[6 * i + 3 : 6 * i + 6, -6:-3] = -(cross @ rotation)
        rows = np.concatenate([np.arange(6 * v, 6 * v + 6) for v in (*others, view)])
        system[np.ix_(rows, rows)] += lift.T @ measured.system @ lift
        right[rows] += lift.T @ measured.right
    motion = np.linalg.solve(system, right).reshape(count, 6).astype(np.float64)
    return replace(cameras, cam_from_world=_rigid(motion) @ cameras.cam_from_world)


def _derivatives(
    sources: Cameras, reference: Cameras, xy: Float64, *, w: Float64
) -> tuple[Float64, Float64]:
    """How source pixels move with the source's pose (S, N, 2, 6) and the inverse depth (S, N, 2).

    A pose moves by a rotation and a translation in the source's own frame.
    """
    ray = np.concatenate([xy, np.ones_like(xy[:, :1])], axis=1)
    ray = ray @ np.linalg.inv(reference.K[0]).T
    relative = sources.cam_from_world @ reference.world_from_cam[0]
    # Points over their depth in the reference, so that a point at infinity is no exception.
    point = np.einsum("sij,nj->sni", relative[:, :3, :3], ray)
    point += w[None, :, None] * relative[:, None, :3, 3]
    x, y, z = np.moveaxis(point, -1, 0)
    z = np.maximum(z, 1e-6)
    K = sources.K[:, None]
    zero = np.zeros_like(x)
    # Of the pixel with respect to the point.
    du = np.stack([K[..., 0, 0] / z, K[..., 0, 1] / z, zero], -1)
    du[..., 2] = -(K[..., 0, 0] * x + K[..., 0, 1] * y) / z**2
    dv = np.stack([zero, K[..., 1, 1] / z, -K[..., 1, 1] * y / z**2], -1)
    chain = np.stack([du, dv], axis=-2)  # (S, N, 2, 3)
    # A rotation moves a point by its cross product with it.
    turn = np.cross(np.stack([x, y, z], -1)[..., None, :], chain)
    shift = chain * w[None, :, None, None]
    along = np.einsum("snij,sj->sni", chain, relative[:, :3, 3])
    return np.concatenate([turn, shift], axis=-1), along


def _eliminate_depths(
    jacobian: Float64, along: Float64, motion: Float64, *, weight: Float64
) -> tuple[Float64, Float64]:
    """Normal equations of the sources' motions, with weights that set outliers aside.

    The weights come from solving the view by itself, the motions held a little.
    """
    count = len(weight)
    hold = np.tile([1e4] * 3 + [1e2] * 3, count)
    pose, depth = np.zeros((count, 6)), np.zeros(weight.shape[1])
    for _ in range(ROUNDS):
        left = motion - np.einsum("snij,sj->sni", jacobian, pose) - along * depth[None, :, None]
        size = np.linalg.norm(left, axis=-1)
        # The scale follows the data downwards: first rounds are forgiving.
        scale = max(SPREAD, 1.2 * float(np.median(size[weight > 0])))
        g = weight / (1 + (size / (OUTLIER * scale)) ** 2) ** 2 / (SHARED * scale**2)
        # Schur complement: each inverse depth's own equation first.
        own = (g * (along**2).sum(-1)).sum(0) + 1e-12
        mixed = np.einsum("sni,snij->snj", g[..., None] * along, jacobian)
        right_own = (g * (along * motion).sum(-1)).sum(0)
        flat = np.moveaxis(mixed, 1, 0).reshape(-1, 6 * count)
        system = -(flat / own[:, None]).T @ flat
        right = -flat.T @ (right_own / own)
        for s in range(count):
            block = slice(6 * s, 6 * s + 6)
            rows = jacobian[s].reshape(-1, 6)
            weighted = rows * np.repeat(g[s], 2)[:, None]
            system[block, block] += weighted.T @ rows
            right[block] += weighted.T @ motion[s].reshape(-1)
        pose = np.linalg.solve(system + np.diag(hold), right).reshape(count, 6)
        depth = (right_own - flat @ pose.reshape(-1)) / own
    return system, right


def _rigid(pose: Float64) -> Float64:
    """(S, 4, 4) rigid motions of rotation vectors and translations (S, 6)."""
    import torch
    from kornia.geometry.liegroup import Se3, So3

    turn, shift = torch.from_numpy(pose).split(3, dim=-1)
    motion: Float64 = Se3(So3.exp(turn), shift).matrix().detach().numpy()
    return motion
