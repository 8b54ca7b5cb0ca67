"""Cameras and points as feed-forward networks save them: arrays by name, or a COLMAP model.

VGGT (``predictions.npz``, ``sparse``), Depth Anything 3 (``exports/npz``, ``mini_npz``, COLMAP),
MapAnything (``predictions.npz``, ``sparse``), DUSt3R and MASt3R (poses, focal lengths, ``pts3d``),
Pi3 (``predictions.npz``: points alone tell the focal lengths), CUT3R (files of each picture), and
scenes of DUSt3R and MASt3R in .glb.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import (
    Cameras,
    Float64,
    concatenate,
    invert_rigid,
    rigid_poses,
    rigid_transform,
)
from gvtools.errors import MemoryFileError, ProjectError, ShapeError
from gvtools.glb import drawn_nodes, glb_numbers, split_glb
from gvtools.scenes.colmap_model import find_model, load_model
from gvtools.scenes.images import read_image
from gvtools.scenes.matching import named
from gvtools.scenes.scene import Finding
from gvtools.untrusted import (
    PIXEL_BYTES,
    PIXEL_RATIO,
    archive,
    load_array,
    load_arrays,
    open_picture,
    read_bytes,
    reading,
)

Arrays = dict[str, NDArray[Any]]

# What the arrays are called. Poses map from the world to the camera, or back.
FROM_WORLD = ("extrinsics", "extrinsic", "cam_from_world", "w2c")
TO_WORLD = (
    "camera_poses", "cam2world", "cams2world", "world_from_cam", "c2w", "im_poses", "poses", "pose"
)  # fmt: skip
INTRINSICS, FOCALS = ("intrinsics", "intrinsic", "K", "Ks"), ("focals", "focal", "im_focals")
DEPTH = ("depth", "depth_map", "depthmaps", "depths", "depth_z")
POINTS = ("world_points", "pts3d", "points")
SURE = ("depth_conf", "world_points_conf", "conf", "confs", "im_conf")
PICTURES = ("images", "image", "imgs", "img_no_norm")
EVERY = {*FROM_WORLD, *TO_WORLD, *INTRINSICS, *FOCALS, *DEPTH, *POINTS, *SURE, *PICTURES}
# Points that are kept, of those no less certain than the median.
MOST_POINTS = 50_000
# A drawn camera's sides agree to this share: what is drawn is in float32.
EXACT = 1e-3
# Of a drawn point.
LEAST_BYTES = 12
# A point is one of a picture's pixels if its colour differs by no more [grey levels].
SAME = 4
EXPECTED = (
    "expected poses (extrinsics, extrinsic, camera_poses, cam2world) and intrinsics in .npz or "
    ".npy, or a COLMAP model, as VGGT, Depth Anything 3, MapAnything, DUSt3R, MASt3R, Pi3 or CUT3R "
    "save them, or a .glb of DUSt3R or MASt3R"
)
# What files of other kinds lack.
LACKS = {
    ".ply": "points without cameras",
    **dict.fromkeys((".pt", ".pth", ".pkl", ".pickle"), "it needs pickle, which may hold code"),
}


@dataclass(frozen=True, eq=False)
class Predictions:
    """V cameras of the pictures that a network saw, and M points that it sees in them."""

    cameras: Cameras  # of the network's pictures
    has_names: bool  # whether the cameras' names are those of pictures
    pictures: NDArray[np.uint8] | None  # (V, h, w, 3) what the network saw
    stretched: bool  # how photographs became its pictures, where it shows none: else cut
    view: NDArray[np.int64]  # (M,) the camera of each point
    xy: Float64  # (M, 2) where that sees it [px of the network's picture]
    points: Float64  # (M,) z-depth in that camera, or (M, 3) in the world
    findings: tuple[Finding, ...] = ()


def read_predictions(path: Path) -> Predictions:
    """What a network saved in a file or a folder."""
    model = find_model(path) if path.is_dir() else None
    if model is not None:
        return _from_colmap(model)
    with reading(f"--poses {path}", EXPECTED, also=(ShapeError, MemoryFileError)):
        if path.suffix.lower() == ".glb" and path.is_file():
            cameras, pictures, seen = _drawn_cameras(path)
            return Predictions(cameras, False, pictures, False, *seen)
        return _from_arrays(_fullest(path))


def _fullest(path: Path) -> Arrays:
    """The arrays of a file, or of that which tells most of a folder's, as Depth Anything 3's."""
    files = sorted(path.rglob("*.np[yz]")) if path.is_dir() else [path]
    frames = [file for file in files if file.parent == path / "camera"]
    if frames:
        return _of_frames(path, [file.stem for file in frames])
    held: dict[Path, set[str]] = {}
    for file in files:
        if file.suffix == ".npy":
            held.setdefault(file.parent, set()).update({file.stem} & EVERY)
        elif file.suffix == ".npz" or not file.is_file():
            with archive(file) as opened:
                held[file] = {name.removesuffix(".npy") for name in opened.namelist()} & EVERY
        else:
            raise ValueError(LACKS.get(file.suffix.lower(), f"of the kind {file.suffix!r}"))
    place = max(held, key=lambda place: len(held[place]), default=path)
    names = held.get(place, set())
    # Of points that depth tells as well, VGGT's would take gigabytes.
    names -= {*POINTS} if names & {*DEPTH} else set()
    if place.is_dir():
        return {name: load_array(place / f"{name}.npy") for name in names}
    return load_arrays(place, *sorted(names)) if names else {}


def _of_frames(path: Path, names: Sequence[str]) -> Arrays:
    """What CUT3R saves of each picture in ``camera``, ``depth``, ``conf`` and ``color``."""
    cameras = [load_arrays(path / f"camera/{name}.npz", "pose", "intrinsics") for name in names]
    arrays = {key: np.stack([camera[key] for camera in cameras]) for key in ("pose", "intrinsics")}
    for kind in ("depth", "conf"):
        if (path / kind).is_dir():
            arrays[kind] = np.stack([load_array(path / kind / f"{name}.npy") for name in names])
    if (path / "color").is_dir():
        colors = [read_image(path / "color" / f"{name}.png").rgb for name in names]
        arrays["images"] = np.stack(colors)
    return arrays


def _from_arrays(arrays: Arrays) -> Predictions:
    def one(names: tuple[str, ...], *ndim: int) -> NDArray[Any] | None:
        name = next((name for name in names if name in arrays), None)
        if name is None:
            return None
        found = arrays[name]
        while found.ndim > max(ndim) and found.shape[0] == 1:
            found = found[0]
        if found.ndim not in ndim or not found.size or found.dtype.kind not in "fiub":
            raise ValueError(f"{name} is of shape {arrays[name].shape} and type {found.dtype}")
        return found

    poses, K, focals = one((*FROM_WORLD, *TO_WORLD), 3), one(INTRINSICS, 2, 3), one(FOCALS, 1, 2)
    depth, world, pictures = one(DEPTH, 3, 4), one(POINTS, 4), one(PICTURES, 4)
    sure = one(SURE, 3, 4)
    if poses is None:
        raise ValueError(f"no poses among {named(sorted(arrays)) or 'its arrays'}")
    rigid = np.stack([
        rigid_transform(pose, what=f"pose {row}")[0] for row, pose in enumerate(poses)
    ])  # fmt: skip
    # MapAnything names so what maps to the world, as 4x4.
    to_world = not arrays.keys() & {*FROM_WORLD}
    to_world |= "extrinsic" in arrays and poses.shape[1:] == (4, 4)
    rigid = invert_rigid(rigid) if to_world else rigid
    depth, sure = (
        each[..., 0] if each is not None and each.ndim == 4 else each for each in (depth, sure)
    )
    if pictures is not None:
        if pictures.shape[1] == 3:
            pictures = pictures.transpose(0, 2, 3, 1)
        if pictures.dtype.kind == "f":
            low = -1 if np.nanmin(pictures) < -0.05 else 0
            pictures = np.clip((pictures - low) / (1 - low), 0, 1) * 255
    shaped = [each for each in (depth, world, pictures, sure) if each is not None]
    if shaped:
        height, width = shaped[0].shape[1:3]
    elif K is not None:
        width, height = np.rint(2 * K[..., :2, 2].reshape(-1, 2)[0]).astype(int)
    for each in shaped:
        if each.shape[:3] != (len(poses), height, width):
            raise ValueError(f"{len(poses)} poses of {width}x{height} pixels beside {each.shape}")
    if K is None and focals is None and world is not None:
        focals = _focal_lengths(world, rigid)
    if K is None:
        if focals is None or not shaped:
            raise ValueError(
                "no intrinsics, nor points, or focal lengths of pictures, to tell them"
            )
        K = np.tile([[1.0, 0, width / 2], [0, 1.0, height / 2], [0, 0, 1]], (len(focals), 1, 1))
        K[:, [0, 1], [0, 1]] = focals.reshape(len(focals), -1)
    # One is of all pictures.
    K = np.broadcast_to(K, (len(poses), *K.shape[-2:])) if K.size == 9 else K
    usable = K.shape == (len(poses), 3, 3) and np.isfinite(K).all()
    if not (usable and (K[:, [0, 1], [0, 1]] > 0).all()):
        raise ValueError(f"{len(poses)} poses, and K of shape {K.shape}, not finite or not above 0")
    K = np.where([[1, 0, 1], [0, 1, 1], [0, 0, 1]], K, 0).astype(np.float64)
    cameras = Cameras.alike(K, rigid, size=(width, height))
    seen = sample_points(depth if depth is not None else world, sure)
    stretched = not to_world and not np.allclose(K[:, 0, 0], K[:, 1, 1], rtol=1e-6)
    shown = None if pictures is None else pictures.astype(np.uint8)
    return Predictions(cameras, False, shown, stretched, *seen)


def _focal_lengths(world: NDArray[Any], poses: Float64) -> Float64:
    """(V, 2) by which cameras with principal points in the middle see points at their pixels."""
    local = np.einsum("vij,vhwj->vhwi", poses[:, :3, :3], world) + poses[:, None, None, :3, 3]
    y, x = np.indices(world.shape[1:3]) + 0.5
    off = np.stack([x - x.mean(), y - y.mean()], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        focals = off * local[..., 2:] / local[..., :2]
    # Near the middle they hang by little.
    outer = np.abs(off) > np.abs(off).max(axis=(0, 1)) / 4
    return np.asarray(np.nanmedian(np.where(outer, focals, np.nan), axis=(1, 2)))


def sample_points(
    values: NDArray[Any] | None, sure: NDArray[Any] | None
) -> tuple[NDArray[np.int64], Float64, Float64]:
    """Of the more certain pixels of depth or points: camera, place, and value."""
    if values is None:
        return np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0)
    usable = np.isfinite(values) & (values > 0) if values.ndim == 3 else (
        np.isfinite(values).all(axis=3)
    )  # fmt: skip
    if sure is not None:
        sure = np.nan_to_num(sure)
        usable &= sure >= np.median(sure)
    rows = np.random.default_rng(0).permutation(np.flatnonzero(usable))[:MOST_POINTS]
    view, y, x = np.unravel_index(np.sort(rows), usable.shape)
    xy = np.column_stack([x, y]).astype(np.float64) + 0.5
    return view.astype(np.int64), xy, values[view, y, x].astype(np.float64)


def _from_colmap(folder: Path) -> Predictions:
    """A model whose pictures may be the network's, reduced and cut."""
    loaded = load_model(folder)
    model, images = loaded.reconstruction, loaded.images
    lenses = [model.cameras[image.camera_id] for image in images]
    bent = sorted({lens.model_name for lens in lenses} - {"PINHOLE", "SIMPLE_PINHOLE"})
    if bent:
        raise ProjectError(
            f"--poses {folder}: cameras of the model {named(bent)}; expected PINHOLE, as networks "
            "save; with the photographs in 'images' beside it, it is a project already"
        )
    cameras = Cameras(
        np.array([lens.calibration_matrix() for lens in lenses]),
        np.array([image.cam_from_world for image in images]),
        np.array([lens.width for lens in lenses]), np.array([lens.height for lens in lenses]),
        tuple(image.name for image in images),
    )  # fmt: skip
    # Each point as the first camera sees it: where VGGT says that pictures show it, they do not.
    first: dict[int, int] = {}
    for row, image in enumerate(images):
        for seen in model.images[image.image_id].get_observation_points2D():
            first.setdefault(int(seen.point3D_id), row)
    kept = sorted(first.keys() & model.points3D.keys())[:: max(1, -(-len(first) // MOST_POINTS))]
    view = np.array([first[key] for key in kept], np.int64)
    points = np.array([model.points3D[key].xyz for key in kept]).reshape(-1, 3)
    pose = cameras.cam_from_world[view]
    local = np.einsum("mij,mj->mi", pose[:, :3, :3], points) + pose[:, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = np.einsum("mij,mj->mi", cameras.K[view], local / local[:, 2:])[:, :2]
    return Predictions(cameras, True, None, False, view, xy, points, loaded.findings)


def _drawn_cameras(
    path: Path,
) -> tuple[Cameras, NDArray[np.uint8], tuple[NDArray[np.int64], Float64, Float64]]:
    """V cameras, their (V, h, w, 3) pictures, and of MOST_POINTS points view, place and position.

    The demos of DUSt3R and MASt3R draw each as a quad that shows the network's picture, and then a
    pyramid from its corners to the optical centre. They tell pose and focal length; the principal
    point is the middle of the picture. ValueError where none are drawn with their pictures.
    """
    tree, body = split_glb(read_bytes(path))
    shapes: list[tuple[dict[str, Any], Float64]] = []
    count = 0
    for node, matrix in drawn_nodes(tree):
        for part in tree["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            local = glb_numbers(tree, body, part["attributes"]["POSITION"]).astype(np.float64)
            shapes.append((part, local @ matrix[:3, :3].T + matrix[:3, 3]))
            count += len(local)
            if count * LEAST_BYTES > len(body):
                raise ValueError("nodes that draw a mesh several times")
    drawn, pixels = list[tuple[Cameras, NDArray[np.uint8]]](), 0
    for quad, pyramid in pairwise(shapes):
        if "TEXCOORD_0" in quad[0]["attributes"] and len(quad[1]) == 4:
            drawn.append(_camera(quad, pyramid[1], tree=tree, body=body))
            pixels += drawn[-1][1].size
            if pixels > PIXEL_BYTES + PIXEL_RATIO * len(body):
                raise ValueError(f"pictures of {pixels} bytes in {len(body)}")
    if not drawn:
        raise ValueError("a scene to look at, in which no cameras are drawn with their pictures")
    cameras = concatenate([camera for camera, _ in drawn])
    pictures = np.stack([picture for _, picture in drawn])
    part, points = shapes[0]
    step = max(1, -(-len(points) // MOST_POINTS))
    colored = part["attributes"].get("COLOR_0")
    colors = np.zeros((0, 3)) if colored is None else 255 * glb_numbers(tree, body, colored)[::step]
    points = points[::step][: len(colors)]
    view, xy = np.full(len(points), -1), np.zeros((len(points), 2))
    for row, (camera, picture) in enumerate(drawn):
        (place,), (z,) = camera.project(points)
        # Whether pixels' centres are at 0 or at 0.5.
        x, y = np.floor(place + 0.25).T
        seen = (z > 0) & (view < 0) & (x >= 0) & (y >= 0)
        seen &= (x < picture.shape[1]) & (y < picture.shape[0])
        shown = picture[y[seen].astype(int), x[seen].astype(int)]
        seen[seen] = np.abs(shown - colors[seen, :3]).max(axis=1) <= SAME
        view[seen], xy[seen] = row, place[seen]
    return cameras, pictures, (view[view >= 0], xy[view >= 0], points[view >= 0])


def _camera(
    quad: tuple[dict[str, Any], Float64], pyramid: Float64, *, tree: dict[str, Any], body: bytes
) -> tuple[Cameras, NDArray[np.uint8]]:
    """A drawn camera, and its picture."""
    part, corners = quad
    texture = tree["materials"][part["material"]]["pbrMetallicRoughness"]["baseColorTexture"]
    image = tree["images"][tree["textures"][texture["index"]]["source"]]
    view = tree["bufferViews"][image["bufferView"]]
    start = view.get("byteOffset", 0)
    with open_picture(body[start : start + view["byteLength"]]) as opened:
        picture = np.asarray(opened.convert("RGB"))
    height, width = picture.shape[:2]
    # Texture coordinates go right and down, from 0 to 1.
    uv = glb_numbers(tree, body, part["attributes"]["TEXCOORD_0"])
    along, down, corner = np.linalg.lstsq(np.column_stack([uv, np.ones(4)]), corners, rcond=None)[0]
    sides = np.linalg.norm([along, down], axis=1)
    x, y = along / sides[0], down / sides[1]
    ahead = np.cross(x, y)
    middle = corner + (along + down) / 2
    tip = pyramid[np.argmin((pyramid - middle) @ ahead)]
    distance = (middle - tip) @ ahead
    off = np.abs([x @ y, sides[0] / sides[1] * height / width - 1]).max()
    if not (off < EXACT and np.linalg.norm(middle - tip - distance * ahead) < EXACT * sides[1]):
        raise ValueError("a picture that no camera is drawn behind")
    rotation = np.array([x, y, ahead])
    pose = rigid_poses(rotation, -rotation @ tip)
    focal = float(distance / sides[1] * height)
    return Cameras.pinhole(width, height, focal=focal, cam_from_world=pose), picture
