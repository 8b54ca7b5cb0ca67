"""Data sets whose cameras a reconstruction found: Mip-NeRF 360, LLFF, DL3DV, ETH3D, ScanNet++ v2.

Files, axes, units and traps of each are in its spec, ``data_specs/data_sets``. Models are COLMAP's
or nerfstudio's; pictures may lie elsewhere, or at another size, than
these say. A scene is read from its largest pictures; ``SCENE/images_4`` asks for reduced copies.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from gvtools.errors import ProjectError
from gvtools.scenes.calibration import MILLIMETRES, finite_array, found_lens, pinhole_lens
from gvtools.scenes.colmap import colmap_frames, colmap_scene, model_in
from gvtools.scenes.colmap_model import (
    ColmapModel,
    RegisteredImage,
    find_model,
    has_model,
    load_model,
)
from gvtools.scenes.images import IMAGE_SUFFIXES, read_depth, readings
from gvtools.scenes.layout import Layout
from gvtools.scenes.matching import natural, pictures_by_stem, scenes_holding
from gvtools.scenes.photographs import Depth, PosedFrame, first_size, posed_scene
from gvtools.scenes.scene import Finding, Scene
from gvtools.scenes.transforms import FILE as TRANSFORMS
from gvtools.scenes.transforms import transforms_frames
from gvtools.scenes.undistort import Undistortion
from gvtools.untrusted import expect, is_file, load_array, read_json, reading, regular

FULL = "images"


# --- folders of reduced copies: ``images``, ``images_2``, ``images_4`` ------------------------


def picture_folders(scene: Path) -> list[Path]:
    """The folders of pictures that a scene has, the largest pictures first."""
    found = [path for path in scene.glob(f"{FULL}*") if path.is_dir() and _factor(path.name)]
    held = [p for p in found if any(item.suffix.lower() in IMAGE_SUFFIXES for item in p.iterdir())]
    return sorted(held, key=lambda path: _factor(path.name))


def variants_of(root: Path, scenes: Iterable[str], *, inside: str = "") -> tuple[str, ...]:
    """Every scene's folders of pictures, which lie ``inside`` it, such as ``garden/images_4``."""
    return tuple(
        f"{scene}/{folder.name}"
        for scene in scenes
        for folder in picture_folders(root / scene / inside)
    )


def chosen_folder(root: Path, scene: str, *, inside: str = "") -> tuple[Path, Path]:
    """A scene's folder, and the pictures that its name chooses: of a variant, else the largest."""
    home = root / scene
    if _factor(home.name):
        for folder in (home.parent / inside / home.name, home):
            if folder.is_dir():
                return home.parent, folder
    folders = picture_folders(home / inside)
    if not folders:
        raise ProjectError(
            f"{home / inside}: no pictures in a folder {FULL} or {FULL}_N; complete the download"
        )
    return home, folders[0]


def _factor(name: str) -> int:
    """By how much the pictures of a folder of that name are reduced; 0 for any other name."""
    match = re.fullmatch(rf"{FULL}(?:_(\d+))?", name, re.ASCII)
    return int(match[1] or 1) if match else 0


# --- Mip-NeRF 360 -----------------------------------------------------------------------------
#
# The model's cameras are of the pictures in ``images``; copies have another size, rounded to whole
# pixels, so intrinsics follow each picture's own width and height.


def _mipnerf360_scenes(root: Path) -> tuple[str, ...]:
    folders = [path for path in root.glob("*") if path.is_dir()]
    return natural(p.name for p in folders if find_model(p) is not None and picture_folders(p))


@Layout.of_reader(
    "SCENE/sparse/0 with SCENE/images or images_N",
    _mipnerf360_scenes,
    variants=lambda root: variants_of(root, _mipnerf360_scenes(root)),
)
def mipnerf360(root: Path, scene: str) -> Scene:
    """A scene of a model beside pictures, in full or reduced."""
    folder, pictures = chosen_folder(root, scene)
    model = model_in(folder)
    by_stem = pictures_by_stem(pictures)

    def picture_of(image: RegisteredImage) -> Path:
        exact = pictures / image.name
        return exact if is_file(exact) else by_stem.get(Path(image.name).stem, exact)

    return colmap_scene(folder, model, colmap_frames(model, picture_of))


# --- LLFF -------------------------------------------------------------------------------------
#
# Each row holds a 3x5 matrix, the first three columns of which are the camera's axes "down, right,
# backwards" in the world, then its centre, then height, width and focal length in pixels of
# ``images``. Rows follow the pictures in the order of their names, so that a row's picture is
# known only where a folder is complete, where ``sparse/0`` names the pictures, or where copies are
# numbered.

POSES_BOUNDS = "poses_bounds.npy"
# Columns "right, down, forward" of the columns "down, right, backwards".
RIGHT_DOWN_FORWARD = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])


def _llff_scenes(root: Path) -> tuple[str, ...]:
    found = scenes_holding(root, f"*/{POSES_BOUNDS}")
    return tuple(name for name in found if picture_folders(root / name))


@Layout.of_reader(
    f"SCENE/{POSES_BOUNDS} with SCENE/images or images_N",
    _llff_scenes,
    variants=lambda root: variants_of(root, _llff_scenes(root)),
)
def _llff(root: Path, scene: str) -> Scene:
    folder, home = chosen_folder(root, scene)
    path = folder / POSES_BOUNDS
    with reading(path, "expected an array of N x 17 numbers; copy it again"):
        rows = load_array(path).astype(np.float64)
        expect(rows.ndim == 2 and rows.shape[1] == 17, f"shape {rows.shape}")
        rows = rows[:, :15].reshape(-1, 3, 5)
        sound = np.isfinite(rows[..., 4]).all()
        expect(sound, "a picture's size or focal length is not finite")
    frames = []
    for row, file in zip(rows, _llff_files(folder, home, len(rows)), strict=True):
        height, width, focal = (float(value) for value in row[:, 4])
        pose = np.concatenate([row[:, :3] @ RIGHT_DOWN_FORWARD, row[:, 3:4]], axis=1)
        lens = pinhole_lens([focal, focal, width / 2, height / 2], (round(width), round(height)))
        frames.append(PosedFrame(file.name, file, lens, pose))
    return posed_scene(folder, frames, poses="world_from_cam", metric=False)


def _llff_files(folder: Path, home: Path, count: int) -> list[Path]:
    """For each row the picture in the folder ``home``, on disk or not."""
    found = pictures_by_stem(home)
    ordered = sorted(found)
    if len(found) == count:
        return [found[stem] for stem in ordered]
    model = find_model(folder)
    if model is not None:
        names = sorted(image.name for image in load_model(model).images)
        if len(names) == count and any(Path(name).stem in found for name in names):
            return [found.get(Path(name).stem, home / name) for name in names]
    if found and all(re.fullmatch(r"image\d{3}", stem) for stem in ordered):
        return [found.get(f"image{i:03d}", home / f"image{i:03d}.png") for i in range(count)]
    raise ProjectError(
        f"{home}: {len(found)} pictures for {count} poses, which follow the pictures' order; "
        "complete the folder, or the scene's sparse/0, which names them"
    )


# --- DL3DV ------------------------------------------------------------------------------------
#
# The file's paths name the folder ``images``, also where only ``images_4`` (960P) or ``images_8``
# (480P) was downloaded: they are taken below the folder that is there. The benchmark keeps all of
# this in ``HASH/nerfstudio``. A download of the COLMAP cache alone is read through the model.

INSIDE = "nerfstudio"  # where the benchmark keeps a scene


def _inside(folder: Path) -> str:
    return INSIDE if (folder / INSIDE).is_dir() else ""


def _dl3dv_scenes(root: Path) -> tuple[str, ...]:
    found = []
    for folder in (*root.glob("*"), *root.glob("*/*")):
        if not folder.is_dir() or folder.name == INSIDE:
            continue
        home = folder / _inside(folder)
        cameras = (home / TRANSFORMS).is_file() or find_model(folder) is not None
        if cameras and picture_folders(home):
            found.append(folder.relative_to(root).as_posix())
    return natural(found)


def _dl3dv_variants(root: Path) -> tuple[str, ...]:
    scenes = _dl3dv_scenes(root)
    inside = {scene: _inside(root / scene) for scene in scenes}
    return tuple(n for scene in scenes for n in variants_of(root, [scene], inside=inside[scene]))


@Layout.of_reader(
    f"HASH/{TRANSFORMS} with HASH/images_4 or images_8", _dl3dv_scenes, variants=_dl3dv_variants
)
def _dl3dv(root: Path, scene: str) -> Scene:
    home = root / scene
    inside = _inside(home) or ("" if home.parent == root else _inside(home.parent))
    folder, pictures = chosen_folder(root, scene, inside=inside)
    file = folder / inside / TRANSFORMS
    if file.is_file():
        frames = transforms_frames(file, pictures)
        return posed_scene(folder, frames, poses="world_from_cam", metric=False)
    model = model_in(folder)
    frames = colmap_frames(model, lambda image: pictures / Path(image.name).name)
    return colmap_scene(folder, model, frames)


# --- ETH3D, high-resolution multi-view --------------------------------------------------------
#
# Undistorted pictures are read where they are there, else the original ones are undistorted here.
# Depth (raw 4-byte floats row by row) was rendered for the *original* pictures. It goes through
# the original camera to the undistorted one, for which ``dslr_calibration_jpg`` is needed.

UNDISTORTED, ORIGINAL = "dslr_calibration_undistorted", "dslr_calibration_jpg"


def _eth3d_scenes(root: Path) -> tuple[str, ...]:
    patterns = [f"{above}{held}/" for above in ("*/", "*/*/") for held in (UNDISTORTED, ORIGINAL)]
    folders = (path for pattern in patterns for path in root.glob(pattern) if has_model(path))
    return natural(path.parent.relative_to(root).as_posix() for path in folders)


@Layout.of_reader(f"SCENE/{UNDISTORTED} with SCENE/images", _eth3d_scenes)
def _eth3d(root: Path, scene: str) -> Scene:
    folder = root / scene
    home, maps = folder / "images", folder / "ground_truth_depth" / "dslr_images"
    original = load_model(folder / ORIGINAL) if has_model(folder / ORIGINAL) else None
    model = original
    if has_model(folder / UNDISTORTED):
        undistorted = load_model(folder / UNDISTORTED)
        if original is None or any(is_file(home / image.name) for image in undistorted.images):
            model = undistorted
    if model is None:
        raise ProjectError(f"{folder}: neither {UNDISTORTED} nor {ORIGINAL}; complete the download")
    frames = colmap_frames(model, lambda image: home / image.name)
    findings = []
    if maps.is_dir() and original is None:
        line = f"depth is of the original pictures and needs {ORIGINAL}, which is absent"
        findings.append(Finding("warning", line))
    elif maps.is_dir() and original is not None:
        frames = _with_raw_depth(maps, frames, original=original, model=model)
    opened = colmap_scene(folder, model, frames, metric=True)
    return replace(opened, findings=(*opened.findings, *findings))


def _with_raw_depth(
    folder: Path, frames: list[PosedFrame], *, original: ColmapModel, model: ColmapModel
) -> list[PosedFrame]:
    """The frames with their depth maps, which are of the original cameras."""
    source = {Path(image.name).name: original.lenses[image.camera_id] for image in original.images}
    target = {image.name: model.lenses[image.camera_id] for image in model.images}
    changes: dict[tuple[int, int], Undistortion] = {}
    found = []
    for frame in frames:
        name = Path(frame.name).name
        if name in source:
            recorded, change = source[name], None
            if model is not original:
                key = id(recorded), id(target[frame.name])
                lens = Undistortion(recorded.source, target[frame.name].target, False)
                change = changes.setdefault(key, lens)
            reader = partial(read_raw_depth, size=recorded.source_size, lens=change)
            frame = replace(frame, depth=folder / name, read_depth=reader)
        found.append(frame)
    return found


def read_raw_depth(path: Path, *, size: tuple[int, int], lens: Undistortion | None = None) -> Depth:
    """(H, W) float32 z-depth, metres, of 4-byte floats without head; 0 for infinity."""
    width, height = size
    with reading(path, f"expected floats of the original camera's size in {ORIGINAL}; copy again"):
        values = np.fromfile(regular(path), "<f4")
        expect(values.size == width * height, f"{values.size} floats, not {width} x {height}")
    depth = readings(values.reshape(height, width))
    return depth if lens is None else np.ascontiguousarray(lens.nearest(depth))


# --- ScanNet++ v2 -----------------------------------------------------------------------------
#
# ``dslr`` and ``iphone`` are a scene each. DSLR: poses and the fisheye camera come from
# ``dslr/colmap``, whose world is the laser scan's (that of ``nerfstudio/transforms.json`` is
# another). Pictures that the data set's tools undistorted are read where they are there, else
# ``resized_images`` are undistorted here. ``render_depth`` of the tools is of the fisheye pictures
# and is read with those alone; anonymisation masks with either. iPhone: ``rgb`` and ``depth`` as
# the tools extract them, with ``aligned_pose``, world_from_cam in the scan's world.

IPHONE_POSES = "pose_intrinsic_imu.json"


def _scannetpp_scenes(root: Path) -> tuple[str, ...]:
    patterns = ("*/dslr/", "*/iphone/", "data/*/dslr/", "data/*/iphone/")
    folders = (path for pattern in patterns for path in root.glob(pattern))
    found = (p for p in folders if has_model(p / "colmap") or (p / IPHONE_POSES).is_file())
    return natural(path.relative_to(root).as_posix() for path in found)


@Layout.of_reader(
    f"SCENE/dslr/colmap or SCENE/iphone/{IPHONE_POSES} with pictures", _scannetpp_scenes
)
def _scannetpp(root: Path, scene: str) -> Scene:
    folder = root / scene
    return _read_dslr(folder) if folder.name == "dslr" else _read_iphone(folder)


def _read_dslr(folder: Path) -> Scene:
    model = model_in(folder / "colmap")
    home, masks = folder / "resized_undistorted_images", folder / "resized_undistorted_masks"
    cameras = folder / "nerfstudio" / "transforms_undistorted.json"
    undistorted = cameras.is_file() and home.is_dir()
    if not undistorted:
        home, masks = folder / "resized_images", folder / "resized_anon_masks"
    lenses, depths = {}, folder / "render_depth"
    if undistorted:
        keys = ("frames", "test_frames")
        lenses = {frame.name: frame.lens for frame in transforms_frames(cameras, home, lists=keys)}
    frames = []
    for frame in colmap_frames(model, lambda image: home / Path(image.name).name):
        png = f"{Path(frame.name).stem}.png"
        if undistorted:
            # Poses stay those of COLMAP: a pinhole looks along the fisheye camera's own axes.
            frame = replace(frame, lens=lenses.get(Path(frame.name).name))
        elif depths.is_dir():
            reader = partial(read_depth, unit=MILLIMETRES)
            frame = replace(frame, depth=depths / png, read_depth=reader)
        frames.append(replace(frame, mask=masks / png if masks.is_dir() else None))
    return colmap_scene(folder, model, frames, metric=True)


def _read_iphone(folder: Path) -> Scene:
    home, depths = folder / "rgb", folder / "depth"
    if not home.is_dir():
        raise ProjectError(
            f"{folder}: no folder rgb; extract it from rgb.mp4 (and depth from depth.bin) with the "
            "data set's own tool, iphone.prepare_iphone_data"
        )
    with reading(folder / IPHONE_POSES, "expected a record for each frame; copy it again"):
        records = read_json(folder / IPHONE_POSES)
        sound = all(isinstance(record, dict) for record in records.values())
        expect(sound, "values that are no records")
    size = first_size(home / f"{name}.jpg" for name in records) or (1920, 1440)
    frames, reader = [], partial(read_depth, unit=MILLIMETRES)
    for name, record in records.items():
        lens = found_lens(record.get("intrinsic"), size, 3, 3)
        pose = finite_array(record.get("aligned_pose"), 4, 4)
        depth = depths / f"{name}.png" if depths.is_dir() else None
        image = home / f"{name}.jpg"
        frames.append(PosedFrame(image.name, image, lens, pose, depth, reader))
    return posed_scene(folder, frames, poses="world_from_cam", metric=True)


LAYOUTS = (mipnerf360, _llff, _dl3dv, _eth3d, _scannetpp)
