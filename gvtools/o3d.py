"""Open3D, with no more threads than the environment allows other libraries."""

from __future__ import annotations

import os

import open3d as o3d

# Open3D counts on TBB, which no variable limits.
_threads = os.environ.get("OMP_NUM_THREADS", "")
if _threads.isdigit() and int(_threads):
    o3d.utility.set_max_threads(int(_threads))

__all__ = ["o3d"]
