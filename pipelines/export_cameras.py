"""The cameras of a memory, with points or without, for COLMAP's and nerfstudio's readers.

Pictures stay where they are. Which of the views a completer made stands in ``generated.txt``
beside the export: one name a line and, where a run has it, the path of the picture.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import ProjectError
from gvtools.files import write_text
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.thinning import thinned
from gvtools.scenes.colmap_writer import write_colmap
from gvtools.scenes.transforms_json import FILE as TRANSFORMS
from gvtools.scenes.transforms_json import write_transforms

GENERATED = "generated.txt"


@dataclass(frozen=True)
class Written:
    """What an export holds.

    Attributes:
        views: cameras.
        generated: how many of them a completer made.
        points: 3D points.
        elements: track elements: which view saw which point, and where.
        edge: voxel edge that the points were thinned to, scene units; 0 without points.
    """

    views: int
    generated: int
    points: int = 0
    elements: int = 0
    edge: float = 0.0


def write_colmap_export(
    memory: SpatialMemory, folder: Path, *, max_points: int | None, run: Path
) -> Written:
    """A workspace with a binary model in ``sparse/0``; pictures belong into its ``images``.

    Each point is the most confident observation of its voxel. Its track are the other observations
    there, one a view, at the pixels where their views have them, so that reprojection errors are
    real.

    Args:
        memory: with at least one observation.
        folder: the workspace.
        max_points: thin to at most so many.
        run: where the memory came from, for the paths of generated pictures.

    Raises:
        ProjectError: two different cameras have one name, or the folder cannot be written.
    """
    cameras, row_of_view = _distinct_cameras(memory)
    kept = thinned(memory, max_points)
    point, view, xy = _tracks(memory, cameras, kept.group, row_of_view)
    write_colmap(
        folder / "sparse" / "0",
        cameras,
        points=memory.positions[kept.rows],
        colors=memory.records.color[kept.rows],
        point_index=point,
        view_index=view,
        xy=xy,
    )
    generated = _write_generated(memory, folder / GENERATED, run)
    return Written(len(cameras), generated, len(kept.rows), len(point), kept.edge)


def write_transforms_export(
    memory: SpatialMemory, path: Path, *, images: str, run: Path
) -> Written:
    """The cameras as ``transforms.json``.

    Args:
        memory: with at least one view.
        path: the file, or the folder for it.
        images: folder of the observed views' pictures, absolute or relative to the file.
        run: where the memory came from; pictures of generated views are those of its rounds.

    Raises:
        ProjectError: two different cameras have one name, or the file cannot be written.
    """
    file = path if path.suffix.lower() == ".json" else path / TRANSFORMS
    cameras, _ = _distinct_cameras(memory)
    pictures = _generated_pictures(memory, run)
    paths: list[str | Path] = []
    for name in cameras.names:
        made = pictures.get(name)
        paths.append(Path(images) / name if made is None else made.resolve())
    write_transforms(file, cameras, image_paths=paths)
    generated = _write_generated(memory, file.with_name(GENERATED), run)
    return Written(len(cameras), generated)


def _distinct_cameras(memory: SpatialMemory) -> tuple[Cameras, NDArray[np.int64]]:
    """Each camera once, and for each view of the memory its row; a view may be fused twice."""
    cameras = memory.views.cameras
    if cameras is None:
        raise ProjectError("the memory has no views; nothing to export")
    first: dict[str, int] = {}
    row: dict[str, int] = {}
    for i, name in enumerate(cameras.names):
        j = first.setdefault(name, i)
        row.setdefault(name, len(row))
        if not (
            np.allclose(cameras.cam_from_world[i], cameras.cam_from_world[j])
            and np.allclose(cameras.K[i], cameras.K[j])
        ):
            raise ProjectError(
                f"two different cameras of the memory are named {name!r}; formats of other tools "
                "need unique names; rename one in the project and run again"
            )
    rows = np.array([row[name] for name in cameras.names], np.int64)
    return cameras[list(first.values())], rows


def _tracks(
    memory: SpatialMemory,
    cameras: Cameras,
    group: NDArray[np.int64],
    row_of_view: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Point, view and pixel of each track element: one observation for each point and view."""
    view = row_of_view[memory.records.view[: len(memory)]]
    order = np.argsort(-memory.confidence, kind="stable")
    pair = group[order] * np.int64(len(cameras)) + view[order]
    _, first = np.unique(pair, return_index=True)
    chosen = np.sort(order[first])
    positions = memory.positions
    xy = np.empty((len(chosen), 2))
    inside = np.zeros(len(chosen), np.bool_)
    for i in range(len(cameras)):
        rows = np.flatnonzero(view[chosen] == i)
        if len(rows):
            xy[rows], z = (values[0] for values in cameras[i].project(positions[chosen[rows]]))
            size = (cameras.width[i], cameras.height[i])
            inside[rows] = (z > 0) & ((xy[rows] >= 0) & (xy[rows] <= size)).all(axis=1)
    chosen, xy = chosen[inside], xy[inside]
    return group[chosen], view[chosen], xy


def _generated_pictures(memory: SpatialMemory, run: Path) -> dict[str, Path | None]:
    """Names of the generated views, and the pictures that a run kept of them."""
    out: dict[str, Path | None] = {}
    for i in np.flatnonzero(memory.views.generated):
        source = memory.views[int(i)]
        name = source.camera.names[0]
        folder = run / f"round_{source.round:03d}"
        picture = folder / f"generated_{_stem(folder, name)}.png"
        out[name] = picture if picture.is_file() else None
    return out


def _stem(folder: Path, name: str) -> str:
    """By what a round's files call a target."""
    from pipelines.round_files import target_stems

    try:
        views = json.loads((folder / "report.json").read_text(encoding="utf-8"))["views"]
        return next(view["stem"] for view in views if view["name"] == name)
    except (OSError, ValueError, KeyError, StopIteration):
        return target_stems((name,))[0]


def _write_generated(memory: SpatialMemory, path: Path, run: Path) -> int:
    pictures = _generated_pictures(memory, run)
    lines = [
        name if picture is None else f"{name}\t{picture}" for name, picture in pictures.items()
    ]
    header = "# views that a completer made: name, and its picture where the run kept it"
    write_text(path, "\n".join([header, *lines]) + "\n")
    return len(pictures)
