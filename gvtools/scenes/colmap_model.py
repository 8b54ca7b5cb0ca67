"""A COLMAP model in memory, read through pycolmap."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import rigid_transform
from gvtools.errors import ProjectError
from gvtools.scenes.colmap_files import ModelFiles, check_cameras, model_files, text_names
from gvtools.scenes.faces import perspective_views
from gvtools.scenes.photographs import rotation_findings
from gvtools.scenes.scene import Finding, SparsePoints, natural_key
from gvtools.scenes.undistort import Undistortion, undistortion

if TYPE_CHECKING:
    import pycolmap

# What the reader's terser complaints mean.
REASONS = {
    "camera.VerifyParams()": "a camera has not as many parameters as its model needs",
    "inserted": "an id occurs twice",
    "unordered_map::at": "an image, camera, rig or frame is named that is not there",
    "line_stream1": "a line of images.txt is malformed; an image has two lines",
    "line_stream2": "a line of images.txt is malformed; an image has two lines",
    "line_stream ": "a line of points3D.txt is malformed",
    "Rig with ID": "an image, camera, rig or frame is named that is not there",
}


@dataclass(frozen=True, eq=False)
class RegisteredImage:
    """One image of a model.

    Attributes:
        image_id: the model's id.
        name: path relative to the image folder.
        camera_id: the model's id of its camera.
        cam_from_world: (4, 4) float64, rigid.
    """

    image_id: int
    name: str
    camera_id: int
    cam_from_world: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A model whose every record was found sound.

    Attributes:
        files: where it was read.
        images: registered images, in natural order of their names.
        views: for each camera that a registered image uses, its ways to a pinhole camera.
        reconstruction: pycolmap's own object.
        findings: what was met.
    """

    files: ModelFiles
    images: tuple[RegisteredImage, ...]
    views: dict[int, tuple[Undistortion, ...]]
    reconstruction: pycolmap.Reconstruction
    findings: tuple[Finding, ...]

    @property
    def lenses(self) -> dict[int, Undistortion]:
        """The one way of each camera of a model that was loaded without faces."""
        return {key: lens for key, (lens,) in self.views.items()}


def load_model(folder: Path, *, faces: bool = False) -> ColmapModel:
    """The model in ``folder``, binary or text, classic or with rigs and frames.

    Args:
        folder: holds its files.
        faces: cameras that see too much for one pinhole camera become several views, see
            ``faces``; without, each camera is one.
    """
    files = model_files(folder)
    findings = []
    if files.others:
        listed = ", ".join(f"{name} ({count} images)" for name, count in files.others)
        findings.append(
            Finding("warning", f"model {folder.name} is read; further models are not: {listed}")
        )
    reconstruction = _read(files)
    if reconstruction.num_reg_images() == 0:
        raise ProjectError(
            f"{folder}: no registered image among {reconstruction.num_images()}; expected at least "
            "one; solve the cameras again, or give another model folder"
        )
    images, defects = _registered(files, reconstruction)
    findings += rotation_findings(defects)
    absent = reconstruction.num_images() - len(images)
    if absent:
        findings.append(
            Finding("warning", f"{absent} of {reconstruction.num_images()} images have no pose")
        )
    used = {image.camera_id for image in images}
    unused = sorted(set(reconstruction.cameras) - used)
    if unused:
        findings.append(Finding("info", f"{len(unused)} cameras of the model are used by no image"))
    views: dict[int, tuple[Undistortion, ...]] = {}
    for key in sorted(used):
        camera = reconstruction.cameras[key]
        size = camera.width, camera.height
        what = f"{folder}, camera {key}"
        if faces:
            views[key] = perspective_views(camera.model_name, camera.params, size, what=what)
        else:
            views[key] = (undistortion(camera.model_name, camera.params, size, what=what),)
    return ColmapModel(files, images, views, reconstruction, tuple(findings))


def _read(files: ModelFiles) -> pycolmap.Reconstruction:
    import pycolmap

    reconstruction = pycolmap.Reconstruction()
    try:
        if files.suffix == ".bin":
            reconstruction.read_binary(files.folder)
            check_cameras(files.folder, reconstruction)
        else:
            reconstruction.read_text(files.folder)
        _ = [image.name for image in reconstruction.images.values()]  # decoded when asked for
    except UnicodeDecodeError:
        raise ProjectError(
            f"{files.folder}: the name of an image is no UTF-8; the file is damaged or of another "
            "encoding; export the model again"
        ) from None
    except (ValueError, IndexError, KeyError, RuntimeError, OSError) as error:
        lines = str(error).split("Check failed:")[-1].strip().splitlines() or ["no reason"]
        reason = next((said for part, said in REASONS.items() if part in lines[0]), lines[0][:120])
        raise ProjectError(
            f"{files.folder}: the model's files are damaged or contradict each other ({reason}); "
            "export the model again"
        ) from None
    return reconstruction


def _registered(
    files: ModelFiles, reconstruction: pycolmap.Reconstruction
) -> tuple[tuple[RegisteredImage, ...], list[float]]:
    """The images with a pose, and how far each rotation was from orthonormal."""
    names = text_names(files.folder) if files.suffix == ".txt" else {}
    images, defects = [], []
    for image in reconstruction.images.values():
        if not image.has_pose:
            continue
        name = names.get(image.image_id, image.name)
        matrix = np.array(image.cam_from_world().matrix())
        matrix[:, :3] = _rotation(image.cam_from_world().rotation.quat)
        pose, defect = rigid_transform(matrix, what=f"{files.folder}, image {name}")
        defects.append(defect)
        images.append(RegisteredImage(image.image_id, name, image.camera_id, pose))
    return tuple(sorted(images, key=lambda image: natural_key(image.name))), defects


def _rotation(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation of a quaternion, times its squared length.

    A quaternion that is not of unit length so gives a scaled rotation, which the check of poses
    either mends exactly or refuses; formulas for unit quaternions would shear it instead.

    Args:
        quaternion: (4,) x, y, z, w.

    Returns:
        (3, 3) float64.
    """
    from scipy.spatial.transform import Rotation

    square = float(quaternion @ quaternion)
    if not 0 < square < np.inf:
        return np.full((3, 3), square)
    return np.asarray(square * Rotation.from_quat(quaternion).as_matrix())


def sparse_points(
    model: ColmapModel, views_of_image: dict[int, list[int]]
) -> tuple[SparsePoints | None, list[Finding]]:
    """The model's points with their tracks in the views' pinhole pixels.

    Args:
        model: a loaded model.
        views_of_image: for the model's image ids, the indices of their views, in the order of
            the camera's ``views``.

    Returns:
        The points ordered by id (None when the model has none), and what was dropped.
    """
    points = model.reconstruction.points3D
    if not len(points):
        return None, [Finding("info", "the model has no sparse points")]
    ids = np.array(sorted(points), np.uint64)
    tracks = [_observations(model, image, views_of_image, ids=ids) for image in model.images]
    point = np.concatenate([track[0] for track in tracks])
    view = np.concatenate([track[1] for track in tracks])
    xy = np.concatenate([track[2] for track in tracks])
    findings = []
    lost = model.reconstruction.compute_num_observations() - len(view)
    if lost:
        findings.append(Finding("info", f"{lost} track elements belong to views that are not read"))
    sound = np.isfinite(xy).all(axis=1)
    if not sound.all():
        bent = int((~sound).sum())
        findings.append(
            Finding("warning", f"{bent} detections lie where the lens has no inverse: dropped")
        )
    # By point, then by view: the model's own order depends on its tables.
    rows = np.lexsort((view, point))
    rows = rows[sound[rows]]
    ordered = [points[int(key)] for key in ids]
    positions = np.array([item.xyz for item in ordered], np.float64)
    if not np.isfinite(positions).all():
        raise ProjectError(
            f"{model.files.folder}: {int((~np.isfinite(positions)).any(axis=1).sum())} sparse "
            "points hold NaN or infinity; expected finite positions; export the model again"
        )
    return (
        SparsePoints(
            positions,
            np.array([item.color for item in ordered], np.uint8),
            np.array([item.error for item in ordered], np.float32),
            point[rows],
            view[rows],
            xy[rows],
        ),
        findings,
    )


def _observations(
    model: ColmapModel,
    image: RegisteredImage,
    views_of_image: dict[int, list[int]],
    *,
    ids: NDArray[np.uint64],
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float64]]:
    """Point index, view index and pinhole pixels of all that one image saw."""
    if image.image_id not in views_of_image:
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
    rows = views_of_image[image.image_id]
    places = np.stack([lens.points(xy) for lens in model.views[image.camera_id]])
    # Faces meet at their sides: the first that shows a detection takes it.
    shown = np.isfinite(places).all(-1).argmax(0)
    return point_index, np.array(rows, np.int32)[shown], places[shown, np.arange(len(xy))]
