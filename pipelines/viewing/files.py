"""Files that ``gvtools export`` writes, opened for viewers.

Each becomes a memory of its points, and keeps its Gaussians or its mesh beside it. Axes are the
file's, which for exports are the input's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import GvError, MemoryFileError
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.optional import require
from gvtools.ply import read_header
from pipelines.export import splat, spz
from pipelines.export.splats import Splats
from pipelines.viewing.gaussians import shown_gaussians
from pipelines.viewing.meshes import load_mesh
from pipelines.viewing.usd_points import GREY, read_usd
from viz.run_view.gaussians import Surface
from viz.run_view.view import MESH, POINTS, RENDERED, SPLATS, RunView

if TYPE_CHECKING:
    import trimesh


def open_file(path: Path) -> RunView | None:
    """What a file shows; None where it is no export but, perhaps, a memory or a run."""
    suffix = path.suffix.lower()
    if not path.is_file() or suffix not in OPENERS:
        return None
    try:
        return OPENERS[suffix](path)
    except GvError:
        raise
    except Exception as error:  # Readers of other packages raise what they please.
        raise MemoryFileError(
            f"{path}: cannot be read as {suffix} ({type(error).__name__}); expected a file as "
            "gvtools export writes it; export it again"
        ) from error


def _open_ply(path: Path) -> RunView | None:
    header = read_header(path)
    if header.holds("face"):
        return _open_mesh(path)
    names = {name for element in header.elements for name, _ in element.columns}
    return _splat_view(path, splat.read(path)) if splat.is_splat(names) else None


def _open_spz(path: Path) -> RunView:
    return _splat_view(path, spz.read(path))


def _open_mesh(path: Path) -> RunView:
    require("trimesh", extra="export", purpose=f"{path}: {path.suffix}")
    import trimesh

    loaded = load_mesh(path)
    if isinstance(loaded, trimesh.PointCloud):
        colors = np.asarray(loaded.colors)[:, :3] if len(loaded.colors) else None
        return _points_view(path, np.asarray(loaded.vertices), colors)
    vertices, colors = np.asarray(loaded.vertices, np.float64), _vertex_colors(loaded)
    surface = Surface(vertices, np.asarray(loaded.faces), colors)
    memory = _memory(path, vertices, colors)
    return RunView(path, memory, (), (), _no_frame, looks=(MESH, POINTS), surface=surface)


def _vertex_colors(mesh: trimesh.Trimesh) -> NDArray[np.uint8]:
    """(V, 3) of any mesh; of a texture, those at the vertices."""
    visual: Any = mesh.visual
    if visual.kind == "texture":
        visual = visual.to_color()
    if visual.kind is None:
        return np.full((len(mesh.vertices), 3), GREY, np.uint8)
    return np.asarray(visual.vertex_colors, np.uint8)[:, :3]


def _open_las(path: Path) -> RunView:
    from gvtools.scans.read import read_scan

    require("laspy", extra="export", purpose=f"{path}: {path.suffix}")

    scan = read_scan(path, generated=True)
    return _points_view(path, scan.positions + scan.origin, scan.colors)


def _open_usd(path: Path) -> RunView:
    return _points_view(path, *read_usd(path))


def _points_view(path: Path, positions: NDArray[Any], colors: NDArray[Any] | None) -> RunView:
    return RunView(
        path, _memory(path, positions, colors), (), (), _no_frame, looks=(POINTS, RENDERED)
    )


def _splat_view(path: Path, splats: Splats) -> RunView:
    if not len(splats):
        raise MemoryFileError(f"{path}: no Gaussians; expected some")
    gaussians = shown_gaussians(splats)
    memory = _memory(path, gaussians.centers, gaussians.colors)
    return RunView(
        path, memory, (), (), _no_frame,
        looks=(SPLATS, POINTS), gaussians_of=lambda most: gaussians,
    )  # fmt: skip


def _memory(path: Path, positions: NDArray[Any], colors: NDArray[Any] | None) -> SpatialMemory:
    import open3d as o3d

    cloud = o3d.t.geometry.PointCloud()
    if colors is None:
        colors = np.full((len(positions), 3), GREY, np.uint8)
    cloud.point.positions = o3d.core.Tensor(np.ascontiguousarray(positions, np.float64))
    cloud.point.colors = o3d.core.Tensor(np.ascontiguousarray(colors, np.uint8))
    try:
        return SpatialMemory.from_point_cloud(cloud, name=path.name)
    except GvError as error:
        raise MemoryFileError(f"{path}: {error}") from None


def _no_frame(name: str) -> None:
    return None


OPENERS: Mapping[str, Callable[[Path], RunView | None]] = {
    ".ply": _open_ply,
    ".spz": _open_spz,
    **dict.fromkeys((".glb", ".obj"), _open_mesh),
    **dict.fromkeys((".las", ".laz"), _open_las),
    **dict.fromkeys((".usd", ".usda", ".usdc"), _open_usd),
}
