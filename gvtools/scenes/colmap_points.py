"""Sparse points of COLMAP models, their tracks in the pixels of a scene's views."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.scenes.colmap_model import ColmapModel, RegisteredImage
from gvtools.scenes.scene import Finding, Scene, SparsePoints
from gvtools.scenes.undistort import Undistortion


def sparse_points(model: ColmapModel, scene: Scene) -> tuple[SparsePoints | None, list[Finding]]:
    """The model's points by id (None without any), tracks in the views' pixels, and findings."""
    points = model.reconstruction.points3D
    if not len(points):
        return None, [Finding("info", "the model has no sparse points")]
    ids = np.array(sorted(points), np.uint64)
    index = {name: i for i, name in enumerate(scene.names)}
    tracks = [_observations(model, image, scene, index=index, ids=ids) for image in model.images]
    point = np.concatenate([track[0] for track in tracks])
    view = np.concatenate([track[1] for track in tracks])
    xy = np.concatenate([track[2] for track in tracks])
    findings = []
    lost = model.reconstruction.compute_num_observations() - len(view)
    if lost:
        findings.append(Finding("info", f"{lost} track elements belong to views that are not read"))
    sound = np.isfinite(xy).all(axis=1)
    if not sound.all():
        line = f"{int((~sound).sum())} detections lie where the lens has no inverse: dropped"
        findings.append(Finding("warning", line))
    # By point, then by view: the model's own order depends on its tables.
    rows = np.lexsort((view, point))
    rows = rows[sound[rows]]
    ordered = [points[int(key)] for key in ids]
    positions = np.array([item.xyz for item in ordered], np.float64)
    colors = np.array([item.color for item in ordered], np.uint8)
    errors = np.array([item.error for item in ordered], np.float32)
    tracks_of = SparsePoints(positions, colors, errors, point[rows], view[rows], xy[rows])
    return tracks_of, findings


def _observations(
    model: ColmapModel,
    image: RegisteredImage,
    scene: Scene,
    *,
    index: dict[str, int],
    ids: NDArray[np.uint64],
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float64]]:
    """Point index, view index and pixels of all that one image saw."""
    lenses = model.views[image.camera_id]
    rows = [index[name] for name in (lens.name(image.name) for lens in lenses) if name in index]
    if not rows:
        return np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 2))
    seen = model.reconstruction.images[image.image_id].get_observation_points2D()
    keys = np.fromiter((point.point3D_id for point in seen), np.uint64, len(seen))
    xy = np.array([point.xy for point in seen], np.float64).reshape(-1, 2)
    point_index = np.minimum(np.searchsorted(ids, keys), len(ids) - 1).astype(np.int32)
    strange = int((ids[point_index] != keys).sum())
    if strange:
        raise ProjectError(
            f"{model.files.folder}: {strange} detections of image {image.name} name points that "
            "points3D does not hold; expected files of one model; export the model again"
        )
    places = np.stack(
        [
            _of_view(lens, scene.views[row].camera.K[0], lens.points(xy))
            for lens, row in zip(lenses, rows, strict=True)
        ]
    )
    # Faces meet at their sides: the first that shows a detection takes it.
    shown = np.isfinite(places).all(-1).argmax(0)
    return point_index, np.array(rows, np.int32)[shown], places[shown, np.arange(len(xy))]


def _of_view(
    lens: Undistortion, K: NDArray[np.float64], xy: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N, 2) pixels of a model's pinhole camera as those of the view, whose picture may be scaled.

    Both look along the same axes from the same place, so that the ray stays the same.
    """
    if np.array_equal(lens.K, K):
        return xy
    change = K @ np.linalg.inv(lens.K)
    return np.asarray(xy @ change[:2, :2].T + change[:2, 2])
