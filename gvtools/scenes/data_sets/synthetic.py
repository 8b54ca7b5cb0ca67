"""Rendered data sets as published: TartanAir, Virtual KITTI, Spring, MVS-Synth, OmniWorld, GTA-SfM.

Files, axes, units and traps of each are in its spec, ``data_specs/data_sets``. Most of them number
their files: a frame is what has a picture or a row of poses.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gvtools.cameras import rigid_poses
from gvtools.errors import ProjectError
from gvtools.scenes.calibration import (
    Float64,
    number_table,
    pinhole_lens,
    quaternion_pose,
    renderer_lens,
)
from gvtools.scenes.images import (
    UNREADABLE,
    decode_picture,
    exr_depth,
    hdf5_array,
    hdf5_depth,
    hdf5_file,
    read_dataset,
    read_depth,
    read_mask,
    readings,
)
from gvtools.scenes.layout import Layout
from gvtools.scenes.matching import natural, numbers_in, scenes_holding
from gvtools.scenes.photographs import Depth, PosedFrame, first_size, posed_scene
from gvtools.scenes.scene import Finding, Frame, Scene, counted
from gvtools.scenes.undistort import LensParameters
from gvtools.untrusted import open_picture, read_json, reading

LensOf = Callable[[Sequence[float], tuple[int, int]], LensParameters | None]
# Of each frame the stored pose and fx, fy, cx, cy, pixels.
StoredCameras = Mapping[int, tuple[Float64, Sequence[float]]]


def numbered_frames(
    images: Path,
    cameras: StoredCameras,
    *,
    names: str,
    depth: Callable[[int], Path],
    read: Callable[[int], Callable[[Path], Depth]],
    lens_of: LensOf = renderer_lens,
    numbers: Iterable[int] = (),
) -> list[PosedFrame]:
    """Frames with a number each, given or else that in the ``names`` of pictures."""
    numbers = sorted(set(numbers) or numbers_in(images, names).union(cameras))
    size = first_size(images / names.format(i) for i in numbers) or (1, 1)
    frames = []
    for i in numbers:
        name, (pose, values) = names.format(i), cameras.get(i, (None, None))
        lens = None if values is None else lens_of(values, size)
        frames.append(PosedFrame(name, images / name, lens, pose, depth(i), read(i)))
    return frames


# --- TartanAir, the first and v2 --------------------------------------------------------------
#
# Row i of ``pose_CAMERA.txt`` is the pose of frame i. Both frames are NED, as aircraft have them;
# the world stays as it is here, the cameras get OpenCV axes. Intrinsics are in no file. Depth is
# an array of metres, or in v2 a float32 whose four bytes are the channels of a PNG in OpenCV's
# order (blue, green, red, alpha).

# The sky is a sphere some kilometres away, at depths such as 10000 (metres).
SKY_FROM = 1000.0
# Camera axes: OpenCV's x (right), y (down), z (forward) as NED's y, z, x.
NED_FROM_OPENCV = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
DIRECTIONS = ("front", "back", "left", "right", "top", "bottom")
CAMERAS = tuple(f"{side}cam_{direction}" for side in "lr" for direction in DIRECTIONS)


def ned_poses(path: Path) -> Float64:
    """(N, 4, 4) world_from_cam of a TartanAir pose file: OpenCV cameras in a NED world."""
    camera = rigid_poses(NED_FROM_OPENCV)
    rows = number_table(path, 7)
    poses = [quaternion_pose(row[[6, 3, 4, 5]], row[:3]) @ camera for row in rows]
    return np.reshape(poses, (-1, 4, 4))


def packed_depth(path: Path) -> Depth:
    """(H, W) float32 z-depth, metres, 0 = none, of a PNG whose channels are a float's bytes."""
    pixels = _pixels(path, "RGBA", "the four bytes of a float as RGBA")
    packed = np.ascontiguousarray(pixels[..., [2, 1, 0, 3]])
    return readings(packed.view("<f4")[..., 0], maximum=SKY_FROM)


def _pixels(path: Path, mode: str, expected: str) -> Any:
    """The values of a picture whose mode begins like that."""
    with reading(path), open_picture(path) as image:
        if not image.mode.startswith(mode):
            raise ProjectError(f"{path}: depth as {image.mode}; expected {expected}")
        values = np.asarray(image)
    return values


def _trajectories(
    name: str,
    holds: str,
    *,
    places: Sequence[str],
    cameras: Sequence[str],
    lens: LensParameters,
    suffix: str,
    reader: Callable[[Path], Depth],
) -> Layout:
    """TartanAir: one scene for each camera of each trajectory, such as "ENV/Easy/P000/left"."""

    def scenes(root: Path) -> tuple[str, ...]:
        return natural(
            f"{folder}/{camera}"
            for camera in cameras
            for held in (f"image_{camera}", f"pose_{camera}.txt")
            for folder in scenes_holding(root, *(f"{place}/{held}" for place in places))
        )

    def read(root: Path, scene: str) -> Scene:
        trajectory, _, camera = scene.rpartition("/")
        folder = root / trajectory
        poses = ned_poses(folder / f"pose_{camera}.txt")
        frames = numbered_frames(
            folder / f"image_{camera}",
            {i: (pose, ()) for i, pose in enumerate(poses)},
            names=f"{{:06d}}_{camera}.png",
            depth=lambda i: folder / f"depth_{camera}" / f"{i:06d}_{camera}_depth{suffix}",
            read=lambda _: reader,
            lens_of=lambda *_: lens,
        )
        return posed_scene(folder, frames, poses="world_from_cam", metric=True)

    return Layout(name, holds, scenes, read)


TARTANAIR = _trajectories(
    "tartanair",
    "ENV/Easy/P000 or ENV/Hard/P000 with image_left and pose_left.txt",
    # The archives hold the environment's folder once more: ENV/ENV/Easy/P000 is as common.
    places=[f"{above}{level}/P*" for above in ("", "*/", "*/*/") for level in ("Easy", "Hard")],
    cameras=("left", "right"),
    lens=pinhole_lens([320.0, 320.0, 320.0, 240.0], (640, 480)),
    suffix=".npy",
    reader=partial(read_depth, maximum=SKY_FROM),
)
TARTANAIR_V2 = _trajectories(
    "tartanair_v2",
    "ENV/Data_easy/P000 with image_lcam_front and pose_lcam_front.txt",
    places=("Data_*/P*", "*/Data_*/P*"),
    cameras=CAMERAS,
    lens=pinhole_lens([320.0, 320.0, 320.0, 320.0], (640, 640)),
    suffix=".png",
    reader=packed_depth,
)


# --- Virtual KITTI 2 --------------------------------------------------------------------------
#
# ``intrinsic.txt`` has rows of frame, camera, fx, fy, cx, cy, ``extrinsic.txt`` of frame, camera
# and the 16 numbers of cam_from_world. The archives unpack into one folder, or into
# ``vkitti_2.0.3_rgb``, ``_depth`` and ``_textgt`` side by side.

CENTIMETRES = 0.01
_KITTI_CAMERAS = ("Camera_0", "Camera_1")


def _part(root: Path, part: str) -> Path:
    """Where one of the archives (rgb, depth, textgt) was unpacked."""
    return next(iter(sorted(root.glob(f"vkitti_*_{part}"))), root)


def _kitti_scenes(root: Path) -> tuple[str, ...]:
    found = (
        path.relative_to(_part(root, part)).parts
        for part in ("rgb", "depth")
        for camera in _KITTI_CAMERAS
        for path in _part(root, part).glob(f"Scene*/*/frames/{part}/{camera}")
    )
    return natural(f"{scene}/{variation}/{camera}" for scene, variation, *_, camera in found)


@Layout.of_reader("SceneNN/VARIATION with frames, intrinsic.txt and extrinsic.txt", _kitti_scenes)
def _virtual_kitti(root: Path, scene: str) -> Scene:
    variation, _, camera = scene.rpartition("/")
    depths = _part(root, "depth") / variation / "frames" / "depth" / camera
    texts = _part(root, "textgt") / variation
    poses, lenses = (
        {
            int(row[0]): row[2:]
            for row in number_table(texts / name, columns, skip=1)
            if row[1] == _KITTI_CAMERAS.index(camera) and np.isfinite(row[0])
        }
        for name, columns in (("extrinsic.txt", 18), ("intrinsic.txt", 6))
    )
    frames = numbered_frames(
        _part(root, "rgb") / variation / "frames" / "rgb" / camera,
        {i: (poses[i].reshape(4, 4), lenses[i]) for i in poses if i in lenses},
        names="rgb_{:05d}.jpg",
        depth=lambda i: depths / f"depth_{i:05d}.png",
        read=lambda _: partial(read_depth, unit=CENTIMETRES),
    )
    return posed_scene(texts, frames, poses="cam_from_world", metric=True, home=root)


# --- Spring, its training part ----------------------------------------------------------------
#
# Disparity is to a camera 0.065 m beside the left one, in pixels of the frame, but at twice its
# resolution. Row i of intrinsics and extrinsics belongs to frame i, counted from 1. Pixels that
# ``maps/skymap_left`` calls sky have no depth.

BASELINE = 0.065  # metres
LEAST_DISPARITY = 1e-9  # pixels
SAME_SURFACE = 0.05  # relative disparity between neighbours of one surface


def spring_depth(path: Path, *, focal: float, sky: Path | None) -> Depth:
    """(H, W) float32 z-depth, metres, 0 = none, of a disparity map of (2 H, 2 W)."""
    disparity = hdf5_array(path, "disparity").astype(np.float64)
    if disparity.ndim != 2 or disparity.shape[0] % 2 or disparity.shape[1] % 2:
        raise ProjectError(f"{path}: disparity {disparity.shape}; expected twice the frame's size")
    disparity = np.where(np.isfinite(disparity) & (disparity > 0), disparity, 0)
    if sky is not None:
        mask = read_mask(sky)
        times = disparity.shape[0] // mask.shape[0]
        if times not in (1, 2) or tuple(times * n for n in mask.shape) != disparity.shape:
            raise ProjectError(
                f"{sky}: {mask.shape}; expected {disparity.shape}, or half of it; copy it again"
            )
        disparity[np.repeat(np.repeat(mask, times, axis=0), times, axis=1)] = 0
    middle = halved(disparity)
    # Nearer to nothing than any disparity is, it gives no depth that float32 holds.
    near = middle > LEAST_DISPARITY
    near &= focal * BASELINE / np.where(near, middle, 1) < np.finfo(np.float32).max
    depth = np.divide(focal * BASELINE, middle, out=np.zeros_like(middle), where=near)
    return depth.astype(np.float32)


def halved(disparity: Float64) -> Float64:
    """(H, W) disparity at the centres of blocks of 2 x 2 of (2 H, 2 W).

    The median of four is exact on planes, whose disparity is affine in the picture. Where an edge
    halves the block, it is the nearer surface's, so that no depth between two is made up.

    >>> halved(np.array([[1.0, 1.125], [1.125, 1.25]]) + 16).item()
    17.125
    """
    height, width = disparity.shape[0] // 2, disparity.shape[1] // 2
    blocks = disparity.reshape(height, 2, width, 2).transpose(0, 2, 1, 3).reshape(height, width, 4)
    ordered = np.sort(blocks, axis=-1)
    far, near = ordered[..., 1], ordered[..., 2]
    return np.where(near - far > SAME_SURFACE * near, near, (far + near) / 2)


def _spring_scenes(root: Path) -> tuple[str, ...]:
    places = [f"{above}[0-9]*" for above in ("", "train/", "spring/train/")]
    held = ("frame_left", "cam_data")
    return scenes_holding(root, *(f"{place}/{name}" for place in places for name in held))


@Layout.of_reader("train/NNNN with frame_left, disp1_left and cam_data", _spring_scenes)
def _spring(root: Path, scene: str) -> Scene:
    folder = root / scene
    skies, sky_name = folder / "maps" / "skymap_left", "skymap_left_{:04d}.png"
    poses = number_table(folder / "cam_data" / "extrinsics.txt", 16).reshape(-1, 4, 4)
    lenses = number_table(folder / "cam_data" / "intrinsics.txt", 4)
    cameras = dict(enumerate(zip(poses, lenses, strict=False), start=1))
    mapped = numbers_in(skies, sky_name)

    def reader(i: int) -> Callable[[Path], Depth]:
        sky = skies / sky_name.format(i) if i in mapped else None
        focal = float(cameras[i][1][0]) if i in cameras else 1.0
        return partial(spring_depth, focal=focal, sky=sky)

    frames = numbered_frames(
        folder / "frame_left",
        cameras,
        names="frame_left_{:04d}.png",
        depth=lambda i: folder / "disp1_left" / f"disp1_left_{i:04d}.dsp5",
        read=reader,
    )
    bare = sum(not frame.read_depth.keywords["sky"] for frame in frames)  # type: ignore[attr-defined]
    line = "frames have no map of the sky: their sky is as far as its disparity says"
    findings = counted(bare, line, level="info")
    return posed_scene(folder, frames, poses="cam_from_world", metric=True, findings=findings)


# --- MVS-Synth --------------------------------------------------------------------------------
#
# The world of the files is left-handed, so that poses have the determinant -1; here its y axis is
# turned round. The unit is the game's and is not published.

# From a right-handed world to the left-handed one of the files, and back.
MIRRORED = np.diag([1.0, -1.0, 1.0, 1.0])


def _synth_camera(path: Path) -> tuple[Float64, tuple[float, ...]]:
    """cam_from_world and fx, fy, cx, cy of a pose file."""
    with reading(path, "expected extrinsic, f_x, f_y, c_x and c_y; copy it again"):
        values = read_json(path)
        pose = np.array(values["extrinsic"], np.float64).reshape(4, 4)
        lens = tuple(float(values[key]) for key in ("f_x", "f_y", "c_x", "c_y"))
    return (pose @ MIRRORED if np.linalg.det(pose[:3, :3]) < 0 else pose), lens


@Layout.of_reader(
    "NNNN or GTAV_NNN/NNNN with images, depths and poses",
    lambda root: scenes_holding(root, "*/images", "*/poses", "*/*/images", "*/*/poses"),
)
def _mvs_synth(root: Path, scene: str) -> Scene:
    folder = root / scene
    names = "{:04d}.json"
    numbers, cameras, damaged = numbers_in(folder / "poses", names), {}, []
    for i in sorted(numbers):
        try:
            cameras[i] = _synth_camera(folder / "poses" / names.format(i))
        except ProjectError as error:
            damaged.append(Finding("warning", str(error)))
    frames = numbered_frames(
        folder / "images",
        cameras,
        names="{:04d}.png",
        depth=lambda i: folder / "depths" / f"{i:04d}.exr",
        read=lambda _: partial(exr_depth, channels=("Y", "R")),
        numbers=numbers | numbers_in(folder / "images", "{:04d}.png"),
    )
    return posed_scene(folder, frames, poses="cam_from_world", metric=False, findings=damaged[:1])


# --- OmniWorld-Game, as its authors' script unpacks it ----------------------------------------
#
# Recordings are cut into splits, each with cameras of its own, so that a split is a scene here:
# ``split_info.json`` lists its frames, ``camera/split_N.json`` holds their cameras. Depth is a
# 16-bit depth buffer between a near plane at 1 and a far one at 1000, times 250; the unit is not
# published. Masks of what moves are not applied.

NEAR, FAR, SCALE = 1.0, 1000.0, 250.0
# Shares of the buffer's range, as the authors' script has them: nearer is too close, farther sky.
NEAREST, FARTHEST = 0.0015, 65500 / 65535


def buffer_depth(path: Path) -> Depth:
    """(H, W) float32 z-depth of OmniWorld's 16-bit depth buffers, 0 where they hold none."""
    share = _pixels(path, "I", "16-bit grey").astype(np.float64) / 65535
    depth = SCALE * share / (FAR - (FAR - NEAR) * share)
    return np.where((share >= NEAREST) & (share <= FARTHEST), depth, 0).astype(np.float32)


def _omniworld_scenes(root: Path) -> tuple[str, ...]:
    files = (f for above in ("", "*/", "*/*/") for f in root.glob(f"{above}camera/split_*.json"))
    return natural(
        f"{file.parent.parent.relative_to(root).as_posix()}/{file.stem}".removeprefix("./")
        for file in files
        if re.fullmatch(r"split_[0-9]+", file.stem)
    )


@Layout.of_reader(
    "SCENE/camera/split_N.json with split_info.json, color and depth", _omniworld_scenes
)
def _omniworld(root: Path, scene: str) -> Scene:
    from scipy.spatial.transform import Rotation

    above, _, split = scene.rpartition("/")
    folder = root / above
    info, path = folder / "split_info.json", folder / "camera" / f"{split}.json"
    expected = f"expected quats, trans, focals, cx and cy of the split's frames in {info.name}"
    with reading(path, f"{expected}; download both again"):
        number = int(split.removeprefix("split_"))
        numbers = [int(frame) for frame in read_json(info)["split"][number]]
        values, count = read_json(path), len(numbers)
        turns = np.array(values["quats"], np.float64).reshape(count, 4)[:, [1, 2, 3, 0]]
        centres = np.array(values["trans"], np.float64).reshape(count, 3)
        poses = rigid_poses(Rotation.from_quat(turns).as_matrix(), centres)
        stored = [np.broadcast_to(values[k], count) for k in ("focals", "focals", "cx", "cy")]
        lenses = np.stack(stored, axis=-1).astype(np.float64)
    frames = numbered_frames(
        folder / "color",
        dict(zip(numbers, zip(poses, lenses, strict=True), strict=True)),
        names="{:06d}.png",
        depth=lambda i: folder / "depth" / f"{i:06d}.png",
        read=lambda _: buffer_depth,
        lens_of=lambda lens, size: pinhole_lens(lens, size) if lens[0] > 0 else None,
        numbers=numbers,
    )
    findings = []
    if numbers_in(folder / "gdino_mask", "{:06d}.png"):
        findings.append(Finding("info", "gdino_mask is not applied: what moves is part of views"))
    return posed_scene(folder, frames, poses="cam_from_world", metric=False, findings=findings)


# --- GTA-SfM ----------------------------------------------------------------------------------
#
# One HDF5 file a sequence, with ``image_0, depth_0, pose_0, K_0`` and so on; images are encoded
# files as bytes. The unit is the game's and is not published.

_GTA_KEY = re.compile(r"(image|depth|pose|K)_([0-9]+)")


def _hdf5_picture(path: Path, *, key: str) -> Frame:
    """The picture that an HDF5 file holds as the bytes of a JPEG or PNG."""
    data = np.asarray(hdf5_array(path, key), np.uint8).tobytes()
    return decode_picture(data, where=f"{path}, {key}")


def _gta_scenes(root: Path) -> tuple[str, ...]:
    files = (file for pattern in ("", "*/") for file in root.glob(f"{pattern}*.hdf5"))
    return natural(file.relative_to(root).with_suffix("").as_posix() for file in files)


@Layout.of_reader("SEQUENCE.hdf5, also below train and test", _gta_scenes)
def _gta_sfm(root: Path, scene: str) -> Scene:
    path = root / f"{scene}.hdf5"
    frames = []
    with hdf5_file(path) as file:
        matches = [match for match in map(_GTA_KEY.fullmatch, file) if match]
        present = {match[0] for match in matches}
        numbers = sorted({int(match[2]) for match in matches})
        images = (f"image_{i}" for i in numbers)
        size = _encoded_size(read_dataset(path, file[key]) for key in images if key in present)
        for i in numbers:
            image, depth, pose, K = (f"{part}_{i}" for part in ("image", "depth", "pose", "K"))
            posed, lens, matrix = pose in present and K in present, None, None
            if posed:
                stored = read_dataset(path, file[K])[[0, 1, 0, 1], [0, 1, 2, 2]]
                lens = renderer_lens(stored, size)
                matrix = np.asarray(read_dataset(path, file[pose]), np.float64)
            # A path that is not there says that the picture or the depth is not.
            picture, map_ = (path if key in present else path / key for key in (image, depth))
            reader, read = partial(hdf5_depth, key=depth), partial(_hdf5_picture, key=image)
            frames.append(PosedFrame(image, picture, lens, matrix, map_, reader, read=read))
    return posed_scene(path, frames, poses="world_from_cam", metric=False)


def _encoded_size(pictures: Iterable[Any]) -> tuple[int, int]:
    """Width and height of the first encoded picture with a sound header, pixels; else 1 x 1."""
    for data in pictures:
        try:
            with open_picture(np.asarray(data, np.uint8).tobytes()) as image:
                return image.size
        except UNREADABLE:
            continue
    return 1, 1


LAYOUTS = (TARTANAIR, TARTANAIR_V2, _virtual_kitti, _spring, _mvs_synth, _omniworld, _gta_sfm)
