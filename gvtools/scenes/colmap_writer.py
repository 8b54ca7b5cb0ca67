"""COLMAP models written through pycolmap: pinhole cameras, images, points with their tracks."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import ProjectError
from gvtools.files import full_disk
from gvtools.scenes.colmap_model import CAMERAS, checked_suffix
from gvtools.scenes.undistort import pinhole_camera

if TYPE_CHECKING:
    import pycolmap

NO_POINTS, NO_TRACKS = np.zeros((0, 3)), np.zeros(0, np.int64)


def write_colmap(
    folder: Path,
    cameras: Cameras,
    *,
    points: NDArray[np.float64] = NO_POINTS,
    colors: NDArray[np.uint8] | None = None,
    point_index: NDArray[np.integer[Any]] = NO_TRACKS,
    view_index: NDArray[np.integer[Any]] = NO_TRACKS,
    xy: NDArray[np.float64] = NO_POINTS[:, :2],
) -> None:
    """Write a binary model that COLMAP and pycolmap read back, in the cameras' own frame.

    Cameras become PINHOLE cameras (views of equal K and size share one), images get the ids
    1..V in the cameras' order and the cameras' names, points the ids 1..N.
    A track element is a ``point_index``, a ``view_index`` and its (M, 2) ``xy``.
    """
    if colors is None:
        colors = np.zeros(points.shape, np.uint8)
    model = build_reconstruction(
        cameras, points, colors, point_index=point_index, view_index=view_index, xy=xy
    )
    partial = folder / ".model.part"
    try:
        # What a kill left of an earlier attempt.
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        model.write_binary(str(partial))
        # The writer does not notice a full disk; the walk over the records does.
        checked_suffix(partial)
        # A kill in between leaves no model, rather than one of new and old files.
        (folder / CAMERAS).unlink(missing_ok=True)
        for file in sorted(partial.iterdir(), key=lambda file: (file.name == CAMERAS, file.name)):
            os.replace(file, folder / file.name)
    except (OSError, ProjectError) as error:
        reason = full_disk(folder) or error
        raise ProjectError(f"{folder}: the model could not be written ({reason})") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def build_reconstruction(
    cameras: Cameras,
    positions: NDArray[np.float64],
    colors: NDArray[np.uint8],
    *,
    point_index: NDArray[np.integer[Any]],
    view_index: NDArray[np.integer[Any]],
    xy: NDArray[np.float64],
) -> pycolmap.Reconstruction:
    """The model in memory; see ``write_colmap``."""
    from gvtools.colmap import pycolmap

    model = pycolmap.Reconstruction()
    camera_ids = _add_cameras(model, cameras)
    # Track elements sorted by view give each image its key points in one block.
    order = np.argsort(view_index, kind="stable")
    start = np.searchsorted(view_index[order], np.arange(len(cameras) + 1))
    keypoint = np.empty(len(order), np.int64)
    keypoint[order] = np.arange(len(order)) - start[view_index[order]]
    for i, name in enumerate(cameras.names):
        seen = xy[order[start[i] : start[i + 1]]]
        image = pycolmap.Image(name=name, keypoints=seen, camera_id=camera_ids[i], image_id=i + 1)
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
    known: dict[tuple[float, ...], int] = {}
    ids = []
    for K, width, height in zip(cameras.K, cameras.width, cameras.height, strict=True):
        key = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], int(width), int(height))
        if key not in known:
            known[key] = len(known) + 1
            camera = pinhole_camera(key[:4], (int(width), int(height)))
            camera.camera_id = known[key]
            model.add_camera_with_trivial_rig(camera)
        ids.append(known[key])
    return ids
