"""The persistent memory: back-projection, fusion by voxel, projection, files."""

from __future__ import annotations

import numba

# Open3D brings an older TBB, about which numba would warn at every start.
numba.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # type: ignore[attr-defined]
