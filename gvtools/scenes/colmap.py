"""COLMAP projects: a model, its pictures, and the masks and depth maps beside them."""

from __future__ import annotations

import os
import re
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.errors import ProjectError, ShapeError
from gvtools.files import replaced_when_written
from gvtools.scenes.colmap_model import ColmapModel, find_model, load_model, sparse_points
from gvtools.scenes.images import read_depth
from gvtools.scenes.matching import named
from gvtools.scenes.photographs import (
    Photograph,
    depth_findings,
    given_folder,
    header_findings,
    lens_findings,
    mask_findings,
)
from gvtools.scenes.scene import Finding, Scene, natural_key
from gvtools.untrusted import is_file, named_file, regular

# Middle and side lengths of a chunk of Hierarchical-3DGS, world frame, scene units.
CHUNK_BOX = ("center.txt", "extent.txt")
# Dense depth maps: ``width&height&channels&``, then float32 row by row.
KINDS = ("geometric", "photometric")  # the first that exists is read
_HEAD = re.compile(rb"(\d{1,9})&(\d{1,9})&(\d{1,9})&")
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".ppm")


def read_colmap(
    root: Path,
    *,
    images: Path | None = None,
    masks: Path | None = None,
    model: int | None = None,
) -> Scene:
    """A COLMAP project with every view in an undistorted pinhole camera.

    Pictures that see too much for one camera become several views, see ``faces``.

    The model is looked for in ``sparse/N``, ``sparse``, ``root`` itself and ``sparse_txt``, the
    pictures in ``images`` beside it, those of a chunk of Hierarchical-3DGS (``chunks/NAME``) in
    ``rectified/images``. Masks follow COLMAP's layout (``masks/NAME.png`` for the image NAME, black
    = ignore). Depth comes from ``stereo/depth_maps`` (geometric before photometric); it is z-depth
    of the recorded camera, which in a dense workspace is the undistorted one already.

    Args:
        images: the image folder, where it is not beside the model.
        masks: the mask folder, where it is not beside the images.
        model: number of the model, where there are several; None takes the largest.

    Returns:
        The scene, in the model's frame and scale.
    """
    root = Path(root)
    folder = find_model(root, number=model)
    if folder is None:
        raise ProjectError(
            f"{root}: no COLMAP model; expected cameras.bin or cameras.txt in sparse/0, in sparse "
            "or in the folder itself"
        )
    loaded = load_model(folder, faces=True)
    homes = _homes(root, folder)
    image_folder = _image_folder(images, homes, folder)
    beside = image_folder.parent
    mask_folder = (
        _first([beside, *homes], "masks") if masks is None else given_folder(masks, "masks")
    )
    depth_folder = _first([*homes, beside], "stereo/depth_maps")
    findings = list(loaded.findings)
    photographs, ids = _photographs(
        loaded, image_folder, mask_folder, depth_folder=depth_folder, findings=findings
    )
    row = {photograph.name: number for number, photograph in enumerate(photographs)}
    rows = {
        image.image_id: [row[lens.name(image.name)] for lens in loaded.views[image.camera_id]]
        for image in loaded.images
        if image.image_id in ids
    }
    points, dropped = sparse_points(loaded, rows)
    lenses = [photograph.lens for photograph in photographs]
    findings += dropped + lens_findings(lenses)
    findings += header_findings([(item.image, item.lens.source_size) for item in photographs])
    findings += _depth_findings(photographs)
    findings += _registered_findings(image_folder, loaded)
    views = tuple(photograph.view() for photograph in photographs)
    return Scene(root, "colmap", views, points, tuple(findings), metric=False)


def _homes(root: Path, folder: Path) -> list[Path]:
    """Folders that may hold ``images``, ``masks`` and ``stereo``, nearest guess first."""
    homes = [root, folder, folder.parent]
    if folder.parent.name in ("sparse", "sparse_txt"):
        homes.append(folder.parent.parent)
    # A chunk of Hierarchical-3DGS: all chunks share the pictures.
    homes += [home.resolve().parents[1] / "rectified" for home in homes if is_chunk(home)]
    return list(dict.fromkeys(path.resolve() for path in homes))


def is_chunk(folder: Path) -> bool:
    """Whether a folder is a chunk of Hierarchical-3DGS: a part of a model, with its box."""
    return all((folder / name).is_file() for name in CHUNK_BOX)


def _image_folder(given: Path | None, homes: list[Path], folder: Path) -> Path:
    found = _first(homes, "images") if given is None else Path(given)
    if found is None:
        raise ProjectError(
            f"{folder}: a model without images: no folder 'images' in "
            f"{', '.join(str(home) for home in homes)}; give it with --images"
        )
    if not found.is_dir():
        raise ProjectError(f"{given}: no such image folder")
    return found


def _first(homes: list[Path], name: str) -> Path | None:
    return next((home / name for home in homes if (home / name).is_dir()), None)


def _photographs(
    model: ColmapModel,
    image_folder: Path,
    mask_folder: Path | None,
    *,
    depth_folder: Path | None,
    findings: list[Finding],
) -> tuple[list[Photograph], set[int]]:
    """The photographs in natural order of their names, and the ids of the images on disk."""
    photographs, ids, absent, unmasked = list[Photograph](), set[int](), list[str](), 0
    for image in model.images:
        path = named_file(image_folder, image.name, where=f"{model.files.folder}, an image")
        if not is_file(path):
            absent.append(image.name)
            continue
        mask = None
        if mask_folder is not None:
            mask = named_file(mask_folder, f"{image.name}.png", where=f"{mask_folder}, a mask")
        if mask is not None and not is_file(mask):
            unmasked += 1
            mask = None
        depth = None if depth_folder is None else _depth_file(depth_folder, image.name)
        reader = read_depth_map if depth is not None and depth.suffix == ".bin" else read_depth
        photographs += [
            Photograph(
                lens.name(image.name),
                path,
                lens,
                lens.pose(image.cam_from_world),
                mask,
                depth,
                reader,
            )
            for lens in model.views[image.camera_id]
        ]
        ids.add(image.image_id)
    if not photographs:
        raise ProjectError(
            f"{image_folder}: none of the model's {len(model.images)} registered images is there "
            f"(looked for {named(absent)}); give the image folder with --images"
        )
    if absent:
        findings.append(
            Finding(
                "warning",
                f"{len(absent)} of {len(model.images)} registered images are absent on disk: "
                + named(absent),
            )
        )
    findings += mask_findings(unmasked, mask_folder)
    return sorted(photographs, key=lambda item: natural_key(item.name)), ids


def _depth_file(folder: Path, name: str) -> Path | None:
    found = depth_map_path(folder, name)
    path = None if found is None else found[0]
    for suffix in (".npy", ".npz"):
        if path is None and is_file(folder / f"{name}{suffix}"):
            path = folder / f"{name}{suffix}"
    return None if path is None else named_file(folder, path, where=f"{folder}, a depth map")


def _depth_findings(photographs: list[Photograph]) -> list[Finding]:
    kinds: Counter[str] = Counter()
    maps = []
    for item in photographs:
        if item.depth is None:
            kinds["none"] += 1
        elif item.depth.suffix != ".bin":
            kinds["arrays"] += 1
        else:
            kinds[item.depth.name.split(".")[-2]] += 1
            maps.append((item.depth, item.lens.source_size))
    findings = depth_findings(maps, depth_map_size)
    if kinds["none"] < len(photographs):
        listed = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
        findings.append(Finding("info", f"depth maps: {listed}"))
    return findings


def _registered_findings(image_folder: Path, model: ColmapModel) -> list[Finding]:
    """How many of the pictures on disk the model knows, and through which cameras."""
    known = {Path(image.name).as_posix() for image in model.images}
    others = 0
    for folder, _, files in os.walk(image_folder):
        relative = Path(folder).relative_to(image_folder)
        for name in files:
            if name.lower().endswith(IMAGE_SUFFIXES):
                others += (relative / name).as_posix() not in known
    models = Counter(views[0].model for views in model.views.values())
    cameras = ", ".join(f"{count} {name}" for name, count in sorted(models.items()))
    line = f"{len(known)} of {others + len(known)} pictures registered; cameras: {cameras}"
    return [Finding("warning" if others > len(known) else "info", line)]


def depth_map_path(folder: Path, name: str) -> tuple[Path, str] | None:
    """The depth map of the image called ``name`` and its kind; None when there is none."""
    for kind in KINDS:
        path = folder / f"{name}.{kind}.bin"
        if is_file(path):
            return path, kind
    return None


def depth_map_size(path: Path) -> tuple[int, int]:
    """Width and height of the depth map at ``path``, pixels, checked against the file's size."""
    return _head(path)[:2]


def _head(path: Path) -> tuple[int, int, int]:
    try:
        with regular(path).open("rb") as file:
            head = _HEAD.match(file.read(64))
        size = path.stat().st_size
    except OSError as error:
        raise ProjectError(f"{path}: unreadable ({error.strerror})") from None
    if head is None:
        raise ProjectError(
            f"{path}: no COLMAP depth map; expected it to start with 'width&height&1&'"
        )
    width, height, channels = (int(group) for group in head.groups())
    expected = head.end() + 4 * width * height * channels
    if channels != 1 or size != expected:
        raise ProjectError(
            f"{path}: {size} bytes with the head {width}x{height}x{channels}; expected {expected} "
            "bytes and one channel; the file is truncated or damaged; compute or copy it again"
        )
    return width, height, head.end()


def read_depth_map(path: Path) -> NDArray[np.float32]:
    """(H, W) float32 z-depth of the map at ``path``, scene units; 0 = none."""
    width, height, start = _head(path)
    values = np.fromfile(regular(path), "<f4", offset=start).reshape(height, width)
    return np.where(np.isfinite(values) & (values > 0), values, 0).astype(np.float32)


def write_depth_map(path: Path, depth: ArrayLike) -> None:
    """Write (H, W) z-depth, scene units, 0 = none, in COLMAP's form."""
    values = np.asarray(depth, "<f4")
    if values.ndim != 2:
        raise ShapeError(f"{path}: depth of shape {values.shape}; expected (H, W)")
    head = f"{values.shape[1]}&{values.shape[0]}&1&".encode()
    with replaced_when_written(path) as temporary:
        temporary.write_bytes(head + values.tobytes())
