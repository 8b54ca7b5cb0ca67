"""Points of USD files, read in a process of its own: OpenUSD ends its process on some damaged ones.

``python -m pipelines.viewing.usd_points FILE`` writes positions and colours as ``.npz`` to its
standard output.
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.untrusted import load_arrays, regular

GREY = 160
# Seconds for a file, and for each byte of it.
SECONDS, SECONDS_PER_BYTE = 60, 1e-6
# Of address space, beside what is mapped already and what the file explains.
SPARE_BYTES = 1 << 29


def read_usd(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """(N, 3) positions and colours of all UsdGeom.Points, in the file's frame."""
    import pxr  # noqa: F401

    size = regular(path).stat().st_size
    try:
        done = subprocess.run(
            [sys.executable, "-m", __name__, str(path.absolute())], capture_output=True,
            timeout=SECONDS + SECONDS_PER_BYTE * size, check=True,
            env={**os.environ, "PXR_WORK_THREAD_LIMIT": "1"},
        )  # fmt: skip
        arrays = load_arrays(done.stdout)
        return arrays["positions"], arrays["colors"]
    except (subprocess.SubprocessError, OSError, ValueError, KeyError):
        raise MemoryFileError(
            f"{path}: no USD with UsdGeom.Points, or one that is damaged or names other files; "
            "expected a file as gvtools export writes it; export it again"
        ) from None


def main() -> None:
    """Read the file that the command line names, and write its points."""
    path = Path(sys.argv[1])
    from pxr import Sdf, Usd, UsdGeom

    _limit_memory(path.stat().st_size)
    layer = Sdf.Layer.OpenAsAnonymous(str(path))
    if layer is None or layer.GetCompositionAssetDependencies():
        sys.exit(1)
    places, colors = [], []
    cache = UsdGeom.XformCache()
    # The stage has to outlive its prims.
    stage = Usd.Stage.Open(layer)
    for prim in stage.Traverse():
        if not prim.IsA(UsdGeom.Points):
            continue
        local = np.asarray(UsdGeom.Points(prim).GetPointsAttr().Get(), np.float64).reshape(-1, 3)
        matrix = np.array(cache.GetLocalToWorldTransform(prim))
        places.append(local @ matrix[:3, :3] + matrix[3, :3])
        color = UsdGeom.Gprim(prim).GetDisplayColorAttr().Get()
        linear = np.full((1, 3), GREY / 255) if color is None else np.asarray(color, np.float64)
        colors.append(np.broadcast_to(_srgb(linear), local.shape))
    out = io.BytesIO()
    np.savez(out, positions=np.concatenate(places), colors=np.concatenate(colors))
    sys.stdout.buffer.write(out.getvalue())


def _limit_memory(size: int) -> None:
    """Let the process take no more than the file explains, where the system tells what it has."""
    status: Any = Path("/proc/self/statm")
    if status.is_file():
        import resource

        pages = int(status.read_text().split()[0])
        most = pages * resource.getpagesize() + 8 * size + SPARE_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


def _srgb(linear: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Linear light as bytes of sRGB."""
    linear = np.clip(linear, 0, 1)
    curved = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.rint(255 * curved).astype(np.uint8)


if __name__ == "__main__":
    main()
