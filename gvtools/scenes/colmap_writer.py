"""Cameras and sparse points written as a COLMAP model."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.cameras import Cameras
from gvtools.errors import ProjectError, ShapeError
from gvtools.scenes.colmap_files import check_model

if TYPE_CHECKING:
    import pycolmap

MODEL_STEMS = ("cameras", "images", "points3D", "rigs", "frames")


def write_colmap(
    folder: Path,
    cameras: Cameras,
    *,
    points: ArrayLike | None = None,
    colors: ArrayLike | None = None,
    point_index: ArrayLike | None = None,
    view_index: ArrayLike | None = None,
    xy: ArrayLike | None = None,
    text: bool = False,
) -> None:
    """Write a model that COLMAP and pycolmap read back, in the cameras' own frame.

    Cameras become PINHOLE cameras (views of equal K and size share one), images get the ids
    1..V in the cameras' order and the cameras' names, points the ids 1..N.

    Args:
        folder: the model folder itself, usually ``workspace/sparse/0``; made when absent.
        cameras: V cameras; K without skew.
        points: (N, 3) float64, world frame, scene units.
        colors: (N, 3) uint8; black when not given.
        point_index: (M,) integers, for each track element its point.
        view_index: (M,) integers, and its view.
        xy: (M, 2) float64, and where it was seen, pixels with the first centre at (0.5, 0.5).
        text: write the text form instead of the binary one.

    Raises:
        ShapeError: arrays that do not fit together, indices out of range, or K with skew.
        ProjectError: the folder holds a binary model that would hide the text, or cannot be
            written.
    """
    folder = Path(folder)
    tracks = _checked_tracks(len(cameras), points, colors, point_index, view_index, xy)
    _check_names(cameras, text)
    if text and any((folder / f"{stem}.bin").exists() for stem in MODEL_STEMS):
        raise ProjectError(
            f"{folder}: holds a binary model, which readers prefer to text; "
            "expected none; choose another folder or remove the .bin files"
        )
    model = _reconstruction(cameras, *tracks)
    try:
        _write(model, folder, text)
    except OSError as error:
        raise ProjectError(f"{folder}: the model could not be written ({error})") from None


def _write(model: pycolmap.Reconstruction, folder: Path, text: bool) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=".model-", dir=folder))
    try:
        if text:
            model.write_text(partial)
        else:
            model.write_binary(partial)
        # The writer does not notice a full disk; the walk over every record does.
        check_model(partial)
        for file in sorted(partial.iterdir()):
            os.replace(file, folder / file.name)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _checked_tracks(
    views: int,
    points: ArrayLike | None,
    colors: ArrayLike | None,
    point_index: ArrayLike | None,
    view_index: ArrayLike | None,
    xy: ArrayLike | None,
) -> tuple[NDArray[Any], ...]:
    positions = np.zeros((0, 3)) if points is None else np.asarray(points, np.float64)
    if positions.ndim != 2 or positions.shape[1] != 3 or not np.isfinite(positions).all():
        raise ShapeError(f"points: shape {positions.shape}; expected (N, 3), finite")
    shade = np.zeros(positions.shape, np.uint8) if colors is None else np.asarray(colors)
    if shade.shape != positions.shape or shade.dtype != np.uint8:
        raise ShapeError(
            f"colors: {shade.dtype} of shape {shade.shape}; expected uint8 of {positions.shape}"
        )
    given = [value is not None for value in (point_index, view_index, xy)]
    if any(given) != all(given):
        raise ShapeError("tracks: point_index, view_index and xy are given together or not at all")
    if not all(given):
        empty = np.zeros(0, np.int64)
        return positions, shade, empty, empty, np.zeros((0, 2))
    of_point = np.asarray(point_index, np.int64)
    of_view = np.asarray(view_index, np.int64)
    where = np.asarray(xy, np.float64)
    if of_point.ndim != 1 or of_view.shape != of_point.shape or where.shape != (len(of_point), 2):
        raise ShapeError(
            f"tracks: point_index {of_point.shape}, view_index {of_view.shape}, xy {where.shape}; "
            "expected (M,), (M,), (M, 2)"
        )
    for name, index, count in (
        ("point_index", of_point, len(positions)),
        ("view_index", of_view, views),
    ):
        if len(index) and (index.min() < 0 or index.max() >= count):
            raise ShapeError(
                f"tracks: {name} runs from {index.min()} to {index.max()}; "
                f"expected 0 to {count - 1}"
            )
    return positions, shade, of_point, of_view, where


def _check_names(cameras: Cameras, text: bool) -> None:
    if len(set(cameras.names)) != len(cameras):
        raise ShapeError("cameras: two views share a name; a model needs unique image names")
    bad = [name for name in cameras.names if not name or "\n" in name or "\0" in name]
    if bad:
        raise ShapeError(f"cameras: the name {bad[0]!r} cannot be an image name in a model")
    blank = [name for name in cameras.names if text and len(name.split()) != 1]
    if blank:
        raise ShapeError(
            f"cameras: the name {blank[0]!r} has a blank, where readers of text models stop; "
            "write the binary form"
        )


def _reconstruction(
    cameras: Cameras,
    positions: NDArray[np.float64],
    colors: NDArray[np.uint8],
    point_index: NDArray[np.int64],
    view_index: NDArray[np.int64],
    xy: NDArray[np.float64],
) -> pycolmap.Reconstruction:
    import pycolmap

    model = pycolmap.Reconstruction()
    camera_ids = _add_cameras(model, cameras)
    # Track elements sorted by view give each image its key points in one block.
    order = np.argsort(view_index, kind="stable")
    start = np.searchsorted(view_index[order], np.arange(len(cameras) + 1))
    keypoint = np.empty(len(order), np.int64)
    keypoint[order] = np.arange(len(order)) - start[view_index[order]]
    for i, name in enumerate(cameras.names):
        image = pycolmap.Image(
            name=name,
            keypoints=xy[order[start[i] : start[i + 1]]],
            camera_id=camera_ids[i],
            image_id=i + 1,
        )
        model.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(np.ascontiguousarray(cameras.cam_from_world[i, :3]))
        )
    by_point = np.argsort(point_index, kind="stable")
    first = np.searchsorted(point_index[by_point], np.arange(len(positions) + 1))
    for i, position in enumerate(positions):
        rows = by_point[first[i] : first[i + 1]]
        track = pycolmap.Track(
            [pycolmap.TrackElement(int(view_index[row]) + 1, int(keypoint[row])) for row in rows]
        )
        model.add_point3D(position, track, colors[i])
    model.update_point_3d_errors()
    return model


def _add_cameras(model: pycolmap.Reconstruction, cameras: Cameras) -> list[int]:
    import pycolmap

    known: dict[tuple[float, ...], int] = {}
    ids = []
    for K, width, height, name in zip(
        cameras.K, cameras.width, cameras.height, cameras.names, strict=True
    ):
        expected = np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
        if not np.allclose(K, expected, atol=1e-9) or not np.isfinite(K).all():
            raise ShapeError(f"cameras: K of {name!r} has skew or is no pinhole matrix: {K}")
        key = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], int(width), int(height))
        if key not in known:
            known[key] = len(known) + 1
            model.add_camera_with_trivial_rig(
                pycolmap.Camera(
                    model="PINHOLE",
                    width=int(width),
                    height=int(height),
                    params=[float(value) for value in key[:4]],
                    camera_id=known[key],
                )
            )
        ids.append(known[key])
    return ids
