"""ATE and RPE of an estimated trajectory against its reference.

python examples/05_trajectory_errors.py [REFERENCE ESTIMATE]  (TUM, KITTI or EuRoC files)
"""

from __future__ import annotations

import sys

import numpy as np

import gvtools


def example_poses() -> tuple[np.ndarray, np.ndarray]:
    """A walk round a circle, and an estimate of it: another frame and scale, and some noise."""
    angle = np.linspace(0, 2 * np.pi, 60)
    reference = np.tile(np.eye(4), (len(angle), 1, 1))
    reference[:, :3, 3] = np.stack([3 * np.cos(angle), 3 * np.sin(angle), 0.1 * angle], axis=1)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    estimate = reference.copy()
    estimate[:, :3, :3] = turn @ reference[:, :3, :3]
    noise = np.random.default_rng(0).normal(0, 0.005, (len(angle), 3))
    estimate[:, :3, 3] = 0.4 * (reference[:, :3, 3] @ turn.T) + noise
    return reference, estimate


if len(sys.argv) > 2:
    reference, estimate = (gvtools.read_poses(path).poses for path in sys.argv[1:3])
else:
    reference, estimate = example_poses()

for name, errors in (
    ("ATE", gvtools.ate(reference, estimate, align="sim3")),
    ("RPE", gvtools.rpe(reference, estimate, align="sim3", delta=1)),
):
    if errors.translation is None or errors.rotation_deg is None:
        print(f"{name}: {errors.status}")
        continue
    print(
        f"{name}: {errors.translation.rmse:.4f} scene units, {errors.rotation_deg.rmse:.3f} degrees"
        f" (rmse of {errors.translation.n}), scale {errors.scale:.3f}"
    )
