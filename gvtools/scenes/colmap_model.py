"""COLMAP models: their files, read through pycolmap.

pycolmap refuses most damage by itself, but takes whatever memory a wrong count asks for, and does
not notice that a binary file ends early: binary files are walked record by record before.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import rigid_transform
from gvtools.errors import ProjectError
from gvtools.scenes.matching import named, natural
from gvtools.scenes.photographs import rotation_findings
from gvtools.scenes.scene import Finding, counted, natural_key
from gvtools.scenes.undistort import Undistortion, perspective_views, undistortion
from gvtools.untrusted import number_key, read_bytes, read_text, reading, regular

if TYPE_CHECKING:
    import pycolmap

# What readers know a model by.
CAMERAS = "cameras.bin"
REQUIRED = ("cameras", "images", "points3D")
RIGGED = ("rigs", "frames")
# Where a model lies inside a workspace, best first. A place may hold several, numbered from 0.
PLACES = ("sparse", ".", "colmap/sparse", "sparse_txt")
# Bytes of the smallest record of each binary file.
LEAST_BYTES = {"cameras": 24, "images": 73, "points3D": 51, "rigs": 8, "frames": 68}
# Where in a record the number of elements stands, its form, theirs, and which column is the image.
ELEMENTS = {"points3D": (43, "<Q", "<II", 0), "frames": (64, "<I", "<iIQ", 2)}
# In texts, which the reader refuses with NaN and infinity, this stands for them.
LOST = 1e300
_NUMBER = re.compile(r"[-+\d.eE]+|[-+]?nan|[-+]?inf")
_NAN = re.compile(r"(?<=\s)[+-]?(nan|inf(inity)?)(?=\s)", re.IGNORECASE)
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


def has_model(folder: Path) -> bool:
    """Whether a folder holds a camera file of COLMAP."""
    return any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))


def find_model(root: Path, *, number: int | None = None) -> Path | None:
    """The model folder of a workspace, or ``root`` when it is one; None when there is none.

    Of several (``sparse/0``, ``sparse/1``, ...) that with the ``number``, else with most images.
    """
    if number is None:
        return next(iter(_models(root)), None)
    known = {
        key: path for place in reversed(PLACES) for key, path in _numbered(root / place).items()
    }
    if number not in known:
        held = ", ".join(map(str, sorted(known))) or "none"
        raise ProjectError(f"{root}: no COLMAP model of number {number}; it holds {held}")
    return known[number]


def _models(root: Path) -> Iterator[Path]:
    """The model of each place of a workspace, that with most images where it holds several."""
    for place in PLACES:
        if numbered := _numbered(root / place):
            yield max(numbered.values(), key=_count_images)
        elif has_model(root / place):
            yield root / place


def other_models(root: Path, folder: Path) -> list[Finding]:
    """A line for each model in another place of a workspace that has other images."""
    counts = {path: _count_images(path) for path in _models(root) if path.parent != folder.parent}
    return [
        Finding("warning", f"{folder} is read, and not {path}, a model of {count} images")
        for path, count in counts.items()
        if count != _count_images(folder)
    ]


def _numbered(folder: Path) -> dict[int, Path]:
    """Models in sub-folders that are numbers, by these, ascending."""
    if folder.name not in ("sparse", "sparse_txt") or not folder.is_dir():
        return {}
    found = [path for path in folder.iterdir() if path.name.isdecimal() and has_model(path)]
    return {int(path.name): path for path in sorted(found, key=lambda path: int(path.name))}


def checked_suffix(folder: Path) -> str:
    """Of the files of the model in ``folder``: complete, and with counts that they can hold."""
    forms = (s for s in (".bin", ".txt") if all((folder / f"{n}{s}").is_file() for n in REQUIRED))
    if (suffix := next(forms, None)) is None:
        found = sorted(path.name for path in folder.iterdir() if path.suffix in (".bin", ".txt"))
        raise ProjectError(
            f"{folder}: an incomplete model, with {', '.join(found)}; expected cameras, images and "
            "points3D, all .bin or all .txt; copy the whole model again"
        )
    rigged = [stem for stem in RIGGED if (folder / f"{stem}{suffix}").is_file()]
    if len(rigged) == 1:
        missing = next(stem for stem in RIGGED if stem not in rigged)
        raise ProjectError(
            f"{folder}: has {rigged[0]}{suffix} without {missing}{suffix}; "
            "expected both or none; copy the whole model again"
        )
    if suffix == ".bin":
        for stem in (*REQUIRED, *rigged):
            path = folder / f"{stem}.bin"
            size, count = path.stat().st_size, _count(path)
            if size < 8 or count * LEAST_BYTES[stem] + 8 > size:
                raise _damaged(path, f"{count} records that its head names cannot be in it")
        for stem in (*REQUIRED[1:], *rigged):
            path = folder / f"{stem}.bin"
            data = read_bytes(path)
            try:
                end = max(_places(data, stem))
            except (struct.error, ValueError):
                end = -1
            if end != len(data):
                raise _damaged(path, "its records take another number")
    else:
        _check_points(folder / "points3D.txt")
    return suffix


def _places(data: bytes, stem: str) -> Iterator[int]:
    """Where each record of a file begins by the counts in those before it, and where all end."""
    at = 8
    yield at
    for _ in range(int(struct.unpack_from("<Q", data)[0])):
        if at > len(data):
            break
        at = _record_end(data, at, stem)
        yield at


def _record_end(data: bytes, at: int, stem: str) -> int:
    if stem == "images":
        name_end = data.index(b"\0", at + 64)
        return name_end + 9 + 24 * int(struct.unpack_from("<Q", data, name_end + 1)[0])
    if stem in ELEMENTS:
        place, form, element, _ = ELEMENTS[stem]
        count = int(struct.unpack_from(form, data, at + place)[0])
        return at + place + struct.calcsize(form) + struct.calcsize(element) * count
    # A rig's id, and its sensors: the first is the reference, the others may have a pose to it.
    sensors = int(struct.unpack_from("<I", data, at + 4)[0])
    at += 8 + (8 if sensors else 0)
    for _ in range(sensors - 1):
        if at >= len(data):
            break
        at += 9 + (56 if struct.unpack_from("<B", data, at + 8)[0] else 0)
    return at


def _check_points(path: Path) -> None:
    """Refuse a line of points3D.txt that lacks a number: pycolmap would read the rest shifted."""
    for at, line in enumerate(read_text(path, errors="replace").splitlines(), 1):
        words = 0 if line.startswith("#") else len(line.split())
        if words and (words < 8 or words % 2):
            raise ProjectError(
                f"{path}, line {at}: {words} values; expected id, x, y, z, r, g, b, error, pairs "
                "of image and feature; export the model again"
            )


def _damaged(path: Path, reason: str) -> ProjectError:
    return ProjectError(
        f"{path}: {path.stat().st_size} bytes, and {reason}; the file is truncated or damaged; "
        "copy or export it again"
    )


def _siblings(folder: Path) -> tuple[tuple[str, int], ...]:
    if folder.parent.name not in ("sparse", "sparse_txt"):
        return ()
    return tuple(
        (path.name, _count_images(path))
        for path in sorted(folder.parent.iterdir())
        if path != folder and path.is_dir() and has_model(path)
    )


def _count_images(folder: Path) -> int:
    """How many images the model in ``folder`` claims to hold; 0 when that cannot be told."""
    if (folder / "images.bin").is_file():
        return _count(folder / "images.bin")
    return len(text_names(folder)) if (folder / "images.txt").is_file() else 0


def _count(path: Path) -> int:
    """The count of records that a binary file begins with."""
    with regular(path).open("rb") as file:
        head = file.read(8)
    return int(struct.unpack("<Q", head)[0]) if len(head) == 8 else 0


def text_names(folder: Path) -> dict[int, str]:
    """The images' whole names in a text model, by id; pycolmap stops at the first blank."""
    path = folder / "images.txt"
    with reading(path):
        lines = read_text(path).splitlines()
    # An image has two lines, the second of which may be empty; empty ones before it do not count.
    names, rest = {}, iter(lines)
    for line in rest:
        if line.strip() and not line.startswith("#"):
            row = line.split(maxsplit=9)
            second = next(rest, "").split()
            if len(row) == 10 and row[0].isdecimal():
                names[number_key(row[0])] = row[9].strip()
                if len(second) == 10 and not _NUMBER.fullmatch(second[-1]):
                    raise ProjectError(
                        f"{path}: image {row[9].strip()} is followed by another, {second[-1]}; "
                        "expected two lines an image, the second with its features or empty; add "
                        "an empty line after each"
                    )
    return names


@dataclass(frozen=True, eq=False)
class RegisteredImage:
    """One image of a model."""

    image_id: int  # the model's id
    name: str  # path relative to the image folder
    camera_id: int  # the model's id of its camera
    cam_from_world: NDArray[np.float64]  # (4, 4) float64, rigid


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A model whose every record was found sound."""

    folder: Path  # where its files are
    images: tuple[RegisteredImage, ...]  # registered images, in natural order of their names
    # for each camera that a registered image uses, its ways to a pinhole camera
    views: dict[int, tuple[Undistortion, ...]]
    reconstruction: pycolmap.Reconstruction  # pycolmap's own object
    findings: tuple[Finding, ...]  # what was met

    @property
    def lenses(self) -> dict[int, Undistortion]:
        """The one way of each camera of a model that was loaded without faces."""
        return {key: lens for key, (lens,) in self.views.items()}


def load_model(folder: Path, *, faces: bool = False) -> ColmapModel:
    """The model in ``folder``, binary or text; with ``faces``, wide cameras become several."""
    suffix, findings = checked_suffix(folder), list[Finding]()
    if others := _siblings(folder):
        listed = ", ".join(f"{name} ({count} images)" for name, count in others)
        line = f"model {folder.name} is read; further models are not: {listed}"
        findings.append(Finding("warning", line))
    reconstruction, mended = _read(folder, suffix)
    findings += mended
    findings += _contradicting_text(folder, reconstruction) if suffix == ".bin" else []
    names = text_names(folder) if suffix == ".txt" else {}
    lost, met = _without_lost(reconstruction, names)
    findings += met
    if reconstruction.num_reg_images() == 0:
        raise ProjectError(
            f"{folder}: no registered image among {reconstruction.num_images()}; expected at least "
            "one; solve the cameras again, or give another model folder"
        )
    images, defects = _registered(folder, reconstruction, names)
    findings += rotation_findings(defects)
    count = reconstruction.num_images()
    if unposed := count - len(images) - lost:
        line = f"{unposed} of {count} images have no pose"
        findings.append(Finding("warning", line, unposed))
    used = {image.camera_id for image in images}
    unused = sorted(set(reconstruction.cameras) - used)
    line = "cameras of the model are used by no image"
    findings += counted(len(unused), line, level="info")
    views: dict[int, tuple[Undistortion, ...]] = {}
    for key in sorted(used):
        camera = reconstruction.cameras[key]
        lens = camera.model_name, camera.params, (camera.width, camera.height)
        what = f"{folder}, camera {key}"
        one = () if faces else (undistortion(*lens, what=what),)
        views[key] = one or perspective_views(*lens, what=what)
    return ColmapModel(folder, images, views, reconstruction, tuple(findings))


def _contradicting_text(folder: Path, reconstruction: pycolmap.Reconstruction) -> list[Finding]:
    """A warning for each text file beside the binary model that says other cameras or poses."""
    records: dict[str, dict[int, list[Any]]] = {
        "cameras": {
            key: [camera.model_name, camera.width, camera.height, *camera.params]
            for key, camera in reconstruction.cameras.items()
        },
        "images": {
            key: ["pose", *image.cam_from_world().rotation.matrix()[:, 2],
                  *image.cam_from_world().translation]
            for key, image in reconstruction.images.items() if image.has_pose
        },
    }  # fmt: skip
    findings = []
    for stem, own in records.items():
        path = folder / f"{stem}.txt"
        told = _told(path)
        for key, (name, *values) in sorted(own.items() if told else ()):
            other, *those = told.get(key, ["none"])
            same = name == other and len(values) == len(those)
            if same and np.allclose(values, those, rtol=1e-3, atol=1e-3):
                continue
            here, there = (np.round(v, 4).tolist() for v in (values, those))
            line = (
                f"{stem}.bin is read, and {path.name} beside it differs: {stem[:-1]} {key} is "
                f"{name} {here}, there {other} {there}; take the wrong one away"
            )
            findings.append(Finding("warning", line))
            break
    return findings


def _told(path: Path) -> dict[int, list[Any]]:
    """The records of a text file as above; none where it is absent or unreadable."""
    try:
        rows = [line.split() for line in read_text(path).splitlines() if line[:1] != "#"]
        if path.stem == "cameras":
            return {int(row[0]): [row[1], *map(float, row[2:])] for row in rows if row}
        heads = [row for row in rows if len(row) > 9 and not _NUMBER.fullmatch(row[9])]
        turned = {int(row[0]): _rotation(np.array(row[2:5] + row[1:2], float)) for row in heads}
        return {int(row[0]): ["pose", *turned[int(row[0])][:, 2], *map(float, row[5:8])]
                for row in heads}  # fmt: skip
    except (OSError, ValueError, IndexError):
        return {}


def _read(folder: Path, suffix: str) -> tuple[pycolmap.Reconstruction, list[Finding]]:
    """The model; where it is refused, without what names images that are not there."""
    try:
        return _parsed(folder, suffix), []
    except ProjectError:
        with TemporaryDirectory() as work:
            try:
                changed = _mend(folder, Path(work), suffix)
            except (struct.error, ValueError, IndexError, OSError):
                changed = None
            if changed is None:
                raise
            reconstruction = _parsed(Path(work), suffix)
    line = "track elements name images that the model does not hold: left out"
    return reconstruction, counted(changed, line)


def _without_lost(
    reconstruction: pycolmap.Reconstruction, names: Mapping[int, str]
) -> tuple[int, list[Finding]]:
    """Take points and poses out that hold no numbers; how many poses, and what is to be said."""
    lost = [key for key, point in reconstruction.points3D.items() if not _known(point.xyz)]
    for key in lost:
        reconstruction.delete_point3D(key)
    findings = counted(len(lost), "sparse points hold NaN or infinity: dropped")
    dropped, frames = list[str](), set[int]()
    for key, image in reconstruction.images.items():
        pose = image.cam_from_world() if image.has_pose else None
        if pose is not None and not (_known(pose.matrix()) and pose.rotation.quat.any()):
            dropped.append(names.get(key, image.name))
            frames.add(image.frame_id)
    for frame in frames:
        reconstruction.deregister_frame(frame)
    if dropped:
        line = (
            f"{len(dropped)} of {reconstruction.num_images()} images have NaN, infinity or a "
            f"quaternion of 0 in their pose: dropped ({named(natural(dropped))})"
        )
        findings.append(Finding("warning", line, len(dropped)))
    return len(dropped), findings


def _known(values: NDArray[np.float64]) -> bool:
    """Whether all numbers are known: neither NaN, infinity nor what stands for them."""
    return bool((np.abs(values) < LOST / 10).all())


def _mend(folder: Path, out: Path, suffix: str) -> int | None:
    """Write a model again without what names absent images; how many elements, None: no change."""
    stems = [stem for stem in (*REQUIRED, *RIGGED) if (folder / f"{stem}{suffix}").is_file()]
    count, changed = 0, False
    if suffix == ".txt":
        known = set(text_names(folder))
    else:
        images = read_bytes(folder / "images.bin")
        places = [*_places(images, "images")][:-1]
        known = {int(struct.unpack_from("<I", images, at)[0]) for at in places}
    for stem in stems:
        data = read_bytes(folder / f"{stem}{suffix}")
        if suffix == ".txt":
            whole = read_text(folder / f"{stem}.txt")
            text = whole if stem == "cameras" else _NAN.sub(f"{LOST}", whole)
            first = {"points3D": 8, "frames": 10}.get(stem)
            lines = []
            for line in text.splitlines():
                words = line.split()
                if first is None or not words or words[0].startswith("#"):
                    lines.append(line)
                    continue
                step, at = (2, 0) if stem == "points3D" else (3, 2)
                parts = [words[i : i + step] for i in range(first, len(words), step)]
                kept = [part for part in parts if int(part[at]) in known]
                count += (len(parts) - len(kept)) * (stem == "points3D")
                if stem == "frames" and parts and not kept:
                    continue
                head = words[:first] if stem == "points3D" else [*words[:9], str(len(kept))]
                lines.append(" ".join([*head, *(word for part in kept for word in part)]))
            new = ("\n".join(lines) + "\n").encode()
            changed |= lines != whole.splitlines() or not data.startswith(text[:1].encode())
        elif stem in ("points3D", "frames"):
            new, left_out = _without(data, stem, known)
            count += left_out * (stem == "points3D")
            changed |= left_out > 0
        else:
            new = data
        (out / f"{stem}{suffix}").write_bytes(new)
    return count if changed else None


def _without(data: bytes, stem: str, known: set[int]) -> tuple[bytes, int]:
    """Records of points3D or frames less elements of images that are not known, and how many."""
    place, form, kind, column = ELEMENTS[stem]
    size, begin = struct.calcsize(kind), place + struct.calcsize(form)
    records, left_out = list[bytes](), 0
    for at, end in pairwise(_places(data, stem)):
        places = range(at + begin, end, size)
        kept = [i for i in places if struct.unpack_from(kind, data, i)[column] in known]
        left_out += len(places) - len(kept)
        if kept or not places or stem == "points3D":
            head = data[at : at + place] + struct.pack(form, len(kept))
            records.append(head + b"".join(data[i : i + size] for i in kept))
    return struct.pack("<Q", len(records)) + b"".join(records), left_out


def _parsed(folder: Path, suffix: str) -> pycolmap.Reconstruction:
    from gvtools.colmap import pycolmap

    reconstruction = pycolmap.Reconstruction()
    try:
        if suffix == ".bin":
            reconstruction.read_binary(folder)
            cameras = reconstruction.cameras.values()
            expected = 8 + sum(24 + 8 * len(camera.params) for camera in cameras)
            if (folder / CAMERAS).stat().st_size != expected:
                raise _damaged(folder / CAMERAS, f"its cameras take {expected}")
        else:
            reconstruction.read_text(folder)
        _ = [image.name for image in reconstruction.images.values()]  # decoded when asked for
    except (ValueError, IndexError, KeyError, RuntimeError, OSError) as error:
        unread = isinstance(error, UnicodeDecodeError)
        text = "the name of an image is no UTF-8" if unread else str(error)
        lines = text.split("Check failed:")[-1].strip().splitlines() or ["no reason"]
        reason = next((said for part, said in REASONS.items() if part in lines[0]), lines[0][:120])
        raise ProjectError(
            f"{folder}: the model's files are damaged or contradict each other ({reason}); "
            "export the model again"
        ) from None
    return reconstruction


def _registered(
    folder: Path, reconstruction: pycolmap.Reconstruction, names: Mapping[int, str]
) -> tuple[tuple[RegisteredImage, ...], list[float]]:
    """The images with a pose, and how far each rotation was from orthonormal."""
    images, defects = [], []
    for image in reconstruction.images.values():
        if not image.has_pose:
            continue
        name = names.get(image.image_id, image.name)
        matrix = np.array(image.cam_from_world().matrix())
        matrix[:, :3] = _rotation(image.cam_from_world().rotation.quat)
        pose, defect = rigid_transform(matrix, what=f"{folder}, image {name}")
        defects.append(defect)
        images.append(RegisteredImage(image.image_id, name, image.camera_id, pose))
    return tuple(sorted(images, key=lambda image: natural_key(image.name))), defects


def _rotation(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) rotation of a quaternion x, y, z, w, times its squared length.

    So one that is not of unit length gives a scaled rotation, which the check of poses either mends
    exactly or refuses; formulas for unit quaternions would shear it instead.
    """
    from scipy.spatial.transform import Rotation

    square = float(quaternion @ quaternion)
    if not 0 < square < np.inf:
        return np.full((3, 3), square)
    return np.asarray(square * Rotation.from_quat(quaternion).as_matrix())
