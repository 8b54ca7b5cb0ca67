"""COLMAP with fixed seeds: features, matches and bundle adjustment of pictures.

Pictures that have poses are stored by their row, ``000000.png`` for the first.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image

if TYPE_CHECKING:
    import pycolmap

SEED = 1
# Most features of a picture, and the longer side that it is reduced to before, pixels.
MAX_FEATURES, MAX_SIDE = 8192, 1600


def extract_sift(
    database: Path,
    images: Path,
    names: Sequence[str],
    *,
    masks: Path | None,
    reader: pycolmap.ImageReaderOptions,
    side: int = MAX_SIDE,
    features: int = MAX_FEATURES,
    first_octave: int = -1,
    one_camera: bool = True,
) -> None:
    """Find SIFT features of some pictures, for a database.

    Pictures are reduced to a longer side of ``side`` pixels before; ``masks`` is a folder, black
    where no feature may be; ``first_octave`` -1 doubles pictures before, 0 takes a quarter of the
    time.
    """
    from gvtools.colmap import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = side
    options.sift.max_num_features = features
    options.sift.first_octave = first_octave
    if masks is not None:
        reader.mask_path = masks
    mode = pycolmap.CameraMode.SINGLE if one_camera else pycolmap.CameraMode.PER_IMAGE
    pycolmap.extract_features(
        database, images, image_names=list(names), camera_mode=mode,
        reader_options=reader, extraction_options=options, device=pycolmap.Device.auto,
    )  # fmt: skip


def list_pairs(pairs: Sequence[tuple[str, str]], work: Path) -> Path:
    """Write a file with pairs of pictures, as COLMAP reads them."""
    file = work / "pairs.txt"
    file.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    return file


def verification() -> pycolmap.TwoViewGeometryOptions:
    """COLMAP's options of verifying matches, the same every time."""
    from gvtools.colmap import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = SEED
    return options


def fix_cameras(options: pycolmap.BundleAdjustmentOptions) -> None:
    """Hold intrinsics, and the relative poses of a rig's cameras, fixed."""
    options.refine_focal_length = False
    options.refine_extra_params = False
    options.refine_sensor_from_rig = False


def adjust(model: pycolmap.Reconstruction, options: pycolmap.BundleAdjustmentOptions) -> None:
    """Bundle-adjust all registered pictures, silently, unlike pycolmap.bundle_adjustment."""
    from gvtools.colmap import pycolmap

    options.print_summary = False
    pycolmap.ObservationManager(model).filter_observations_with_negative_depth()
    config = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def write_pictures(
    pictures: Iterable[tuple[NDArray[np.uint8], NDArray[np.bool_] | None]], folder: Path
) -> list[str]:
    """Write pictures (H, W, 3) and masks (H, W), None for all of it, to ``images`` and ``masks``.

    COLMAP wants a mask for every picture where there is a folder of them.
    """
    names = []
    for name in ("images", "masks"):
        (folder / name).mkdir()
    for row, (rgb, mask) in enumerate(pictures):
        names.append(f"{row:06d}.png")
        Image.fromarray(rgb).save(folder / "images" / names[-1], compress_level=1)
        usable = np.ones(rgb.shape[:2], bool) if mask is None else mask
        bright = Image.fromarray(usable.astype(np.uint8) * 255)
        bright.save(folder / "masks" / f"{names[-1]}.png", compress_level=1)
    return names


def row_of(image: pycolmap.Image) -> int:
    """The row of a picture that ``write_pictures`` wrote."""
    return int(Path(image.name).stem)


def set_intrinsics(database: Path, K: NDArray[np.float64]) -> None:
    """Give the cameras of the pictures, PINHOLE, their known intrinsics (V, 3, 3)."""
    from gvtools.colmap import pycolmap

    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            own, camera = K[row_of(image)], opened.read_camera(image.camera_id)
            camera.params = [own[0, 0], own[1, 1], own[0, 2], own[1, 2]]
            camera.has_prior_focal_length = True
            opened.update_camera(camera)


def posed_model(database: Path, cam_from_world: NDArray[np.float64]) -> pycolmap.Reconstruction:
    """A model without points of the pictures at known poses (V, 4, 4), with their keypoints."""
    from gvtools.colmap import pycolmap

    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            model.add_camera_with_trivial_rig(opened.read_camera(image.camera_id))
            posed = pycolmap.Image(
                name=image.name,
                keypoints=opened.read_keypoints(image.image_id)[:, :2].astype(np.float64),
                camera_id=image.camera_id,
                image_id=image.image_id,
            )
            pose = pycolmap.Rigid3d(cam_from_world[row_of(image), :3])
            model.add_image_with_trivial_frame(posed, pose)
    return model
