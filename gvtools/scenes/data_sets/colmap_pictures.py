"""Frames of a COLMAP model whose pictures lie elsewhere, or at another size, than it says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from gvtools.errors import ProjectError
from gvtools.scenes.colmap_files import find_model
from gvtools.scenes.colmap_model import ColmapModel, RegisteredImage, load_model, sparse_points
from gvtools.scenes.data_sets.posed_pictures import PosedPicture, posed_scene
from gvtools.scenes.scene import Scene, SparsePoints
from gvtools.scenes.transforms_frame import LensParameters


def model_in(folder: Path) -> ColmapModel:
    """The COLMAP model of a folder."""
    found = find_model(folder)
    if found is None:
        raise ProjectError(
            f"{folder}: no COLMAP model; expected cameras.bin or cameras.txt in sparse/0, sparse "
            "or the folder itself; complete the download"
        )
    return load_model(found)


def lens_of(model: ColmapModel, camera_id: int) -> LensParameters:
    """A camera of a model as it was recorded."""
    camera = model.reconstruction.cameras[camera_id]
    values = tuple(float(value) for value in camera.params)
    return LensParameters(camera.model_name, values, (int(camera.width), int(camera.height)))


def colmap_pictures(
    model: ColmapModel, picture_of: Callable[[RegisteredImage], Path]
) -> list[PosedPicture]:
    """The model's images as frames, named as the model names them.

    Args:
        model: a loaded model.
        picture_of: where an image's picture should be.
    """
    lenses = {key: lens_of(model, key) for key in model.lenses}
    return [
        PosedPicture(image.name, picture_of(image), lenses[image.camera_id], image.cam_from_world)
        for image in model.images
    ]


def colmap_scene(
    root: Path, model: ColmapModel, pictures: list[PosedPicture], *, metric: bool = False
) -> Scene:
    """The scene of a model's frames with its sparse points, detections in the views' pixels.

    Args:
        root: the scene's folder.
        model: a loaded model.
        pictures: frames named as the model names its images; not every one has to be there.
        metric: whether the model's unit is the metre.
    """
    scene = posed_scene(
        root, pictures, poses="cam_from_world", metric=metric, findings=model.findings
    )
    index = {name: i for i, name in enumerate(scene.names)}
    views_of_image = {
        image.image_id: [index[image.name]] for image in model.images if image.name in index
    }
    points, findings = sparse_points(model, views_of_image)
    if points is not None:
        points = _resized(points, model, scene)
    return replace(scene, points=points, findings=(*scene.findings, *findings), kind="colmap")


def _resized(points: SparsePoints, model: ColmapModel, scene: Scene) -> SparsePoints:
    """Detections moved from the pinholes of the model's cameras to those of the views.

    Both look along the same axes from the same place, so that the ray stays the same.
    """
    camera_of = {image.name: image.camera_id for image in model.images}
    change = np.stack(
        [
            view.camera.K[0] @ np.linalg.inv(model.lenses[camera_of[view.name]].K)
            for view in scene.views
        ]
    )[points.view_index]
    flat = np.concatenate([points.xy, np.ones((len(points.xy), 1))], axis=1)
    xy = np.einsum("nij,nj->ni", change, flat)
    if not np.isfinite(xy).all():
        raise ProjectError(
            f"{model.files.folder}: detections and cameras that do not belong together; download "
            "the model again"
        )
    return replace(points, xy=xy[:, :2])
