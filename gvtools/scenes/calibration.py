"""Cameras and poses as files hold them: tables of numbers, matrices, lenses, pixel centres."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.cameras import rigid_poses
from gvtools.errors import ProjectError
from gvtools.scenes.scene import Finding
from gvtools.scenes.undistort import LensParameters, camera_of
from gvtools.untrusted import expect, load_array, parse_yaml, read_json, read_text, reading

Float64 = NDArray[np.float64]

MILLIMETRES = 1e-3
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
INTRINSICS, FLAT = "camera-intrinsics.txt", ("fx", "fy", "cx", "cy")
# fx, fy, cx, cy of a Kinect-like sensor as PrimeSense's driver and Open3D have them, 640x480.
SENSOR_DEFAULT, DEFAULT_SIZE = (525.0, 525.0, 319.5, 239.5), (640, 480)
# A principal point may be so far from the middle, in half sides, and still be of its picture. One
# of another size tells that by both axes alike, unless that is as good as a whole multiple.
OFF_CENTER, ALIKE, WHOLE, MOST = 0.15, 0.02, 0.005, 16
# Where the sky is in a picture, as x and y.
DIRECTIONS = {"up": (0, -1), "left": (-1, 0), "down": (0, 1), "right": (1, 0)}


# --- files ------------------------------------------------------------------------------------


def number_table(path: Path, columns: int, *, skip: int = 0, required: bool = False) -> Float64:
    """(N, columns) float64 of a text file with one row a line."""
    if not required and not path.exists():
        return np.zeros((0, columns))
    with reading(path, f"expected {columns} numbers in each row; download it again"):
        rows = [line.split() for line in read_text(path).splitlines()[skip:] if line.strip()]
        for number, row in enumerate(rows, start=1):
            expect(len(row) == columns, f"row {number} of {len(rows)} has {len(row)} numbers")
        expect(rows or not required, "no rows")
        return np.array(rows, np.float64).reshape(-1, columns)


def load_matrix(path: Path, *shapes: tuple[int, int]) -> Float64:
    """A matrix of one of the shapes, in rows or in one line, in a text file or an ``.npy``."""
    expected = " or ".join(f"{rows}x{columns}" for rows, columns in shapes)
    with reading(path, f"expected {expected} numbers"):
        npy = path.suffix == ".npy"
        lines = [] if npy else read_text(path).replace(",", " ").splitlines()
        matrix = load_array(path) if npy else np.loadtxt(lines, np.float64, ndmin=2)
        by_size = {rows * columns: (rows, columns) for rows, columns in shapes}
        if max(matrix.shape, default=0) == matrix.size in by_size:
            matrix = matrix.reshape(by_size[matrix.size])
        expect(matrix.shape in shapes, f"{'x'.join(map(str, matrix.shape))} numbers")
        return matrix.astype(np.float64)


def csv_rows(path: Path, *, again: str = "copy it again") -> list[dict[str, str]]:
    """The rows of a CSV file by the names of its header."""
    with reading(path, again):
        return list(csv.DictReader(read_text(path).splitlines(), skipinitialspace=True))


def json_object(path: Path) -> Mapping[str, Any]:
    """The JSON object in a file; empty where it is absent or damaged, as if it had no key."""
    try:
        found = read_json(path)
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def finite_array(values: object, *shape: int) -> Float64 | None:
    """Finite numbers of that shape, flat or nested; None where the values are others."""
    try:
        array = np.asarray(values, np.float64)
    except (OverflowError, TypeError, ValueError):
        return None
    if array.size != int(np.prod(shape)) or not np.isfinite(array).all():
        return None
    return array.reshape(shape)


# --- intrinsics -------------------------------------------------------------------------------


def pinhole(values: Sequence[float]) -> Float64:
    """(3, 3) intrinsics of fx, fy, cx, cy, pixels."""
    fx, fy, cx, cy = values
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def intrinsics_beside(root: Path) -> tuple[Float64, str] | None:
    """(3, 3) as published and the file's name: ``camera-intrinsics.txt`` or Open3D's JSON.

    The text file may also stand in the parent folder. ``camera.json`` has to hold intrinsics, other
    JSON may. Files that differ are refused.
    """
    places = (root / INTRINSICS, root.resolve().parent / INTRINSICS)
    texts = [path for path in places if path.is_file()][:1]
    found = [(load_matrix(path, (3, 3)), path) for path in texts]
    for path in sorted(root.glob("*.json")):
        text = file_text(path)
        flat = all(f'"{key}"' in text for key in FLAT)
        if path.is_file() and (path.name == "camera.json" or flat or "intrinsic_matrix" in text):
            found.append((open3d_intrinsics(path), path))
            break
    if len(found) == 2 and not np.allclose(found[0][0], found[1][0], rtol=1e-4):
        raise ProjectError(
            f"{found[0][1]} and {found[1][1].name} differ; expected the same intrinsics; take one "
            "away, or give color_K (--color-intrinsics)"
        )
    return (found[0][0], found[0][1].name) if found else None


def exported_file(root: Path, name: str) -> Path:
    """A file of an export like ScanNet's, at one of the places where exporters put it."""
    folders = (root / "intrinsic", root / "intrinsics", root)
    return next((f / name for f in folders if (f / name).is_file()), root / name)


def exported_intrinsics(root: Path, camera: str) -> list[tuple[Float64, str]]:
    """(3, 3) of the "color" or "depth" camera and the file, for each that an exporter wrote."""
    names = [f"intrinsic_{camera}", f"intrinsics_{camera}", f"{camera}_intrinsic",
             f"{camera}_intrinsics"]  # fmt: skip
    if camera == "color":
        names += ["intrinsic", "intrinsics", "camera_intrinsics", "K", "cam_K"]
    found = list[tuple[Float64, str]]()
    for name in names:
        if (path := exported_file(root, f"{name}.txt")).is_file():
            matrix = load_matrix(path, (4, 4), (3, 4), (3, 3), (1, 4))
            found.append((pinhole(matrix[0]) if len(matrix) == 1 else matrix[:3, :3], path.name))
    beside = intrinsics_beside(root) if camera == "color" else None
    found += [beside] if beside else []
    # The scan's own are of pictures as they were recorded, before any export.
    for path in (root / "_info.txt", root / "info.txt", root / f"{root.resolve().name}.txt"):
        if path.is_file() and not found:
            with reading(path):
                lines = (line.partition("=") for line in read_text(path).splitlines())
            told = {key.strip(): value.split() for key, _, value in lines}
            K = finite_array(told.get(f"m_calibration{camera.title()}Intrinsic"), 4, 4)
            keys = [f"{name}_{camera}" for name in ("fx", "fy", "mx", "my")]
            values = finite_array([told.get(key, ["x"])[0] for key in keys], 4)
            found += [(K[:3, :3], path.name)] if K is not None else []
            found += [(pinhole(values.tolist()), path.name)] if values is not None else []
    return found


def file_text(path: Path) -> str:
    """As long as it can be read: a damaged calibration still tells that it is one."""
    try:
        return read_text(path)
    except (OSError, ValueError):
        return ""


def times_as_large(center: ArrayLike, size: tuple[int, int]) -> float:
    """How many times as large the picture is that a point is the middle of; 1 of this ``size``.

    >>> times_as_large((648, 484), (648, 484)), times_as_large((330, 230), (648, 484))
    (2.0, 1.0)
    """
    x, y = 2 * np.asarray(center, np.float64) / size
    mean = float(x + y) / 2
    if not 1 / MOST < mean < MOST or max(abs(x - 1), abs(y - 1)) < OFF_CENTER:
        return 1.0
    times = float(round(mean)) if mean > 1 else 1 / round(1 / mean)
    if abs(x - y) < ALIKE * mean and abs(mean / times - 1) > WHOLE:
        return mean
    return times if max(abs(x / times - 1), abs(y / times - 1)) < OFF_CENTER else 1.0


def open3d_intrinsics(path: Path) -> Float64:
    """(3, 3) intrinsics of Open3D's JSON form, column by column, or of four numbers by name."""
    form = "expected Open3D's form with 'intrinsic_matrix' as nine numbers, column by column"
    with reading(path, f"{form}, or fx, fy, cx and cy"):
        told = read_json(path)
        told = told.get("camera", told)
        if set(FLAT) <= {*told}:
            return pinhole([float(told[key]) for key in FLAT])
        return np.array(told["intrinsic_matrix"], np.float64).reshape(3, 3).T


def sensor_default(size: tuple[int, int] | None = None) -> tuple[Float64, Finding]:
    """(3, 3) of pictures of ``size`` where no file has intrinsics, and the warning that says so."""
    width, height = size or DEFAULT_SIZE
    focal = SENSOR_DEFAULT[0] * width / DEFAULT_SIZE[0]
    taken = (focal, focal, (width - 1) / 2, (height - 1) / 2)
    values = ", ".join(f"{value:g}" for value in taken)
    line = (
        f"no intrinsics file: the PrimeSense driver's default {values} is taken for {width}x"
        f"{height} pixels; of another camera surfaces bend and views come out worse (one "
        f"recording: 21.7 instead of 26.1 dB); write {INTRINSICS}, or give --color-intrinsics"
    )
    return pinhole(taken), Finding("warning", line)


def opencv_lens(path: Path) -> LensParameters:
    """A camera of a calibration in OpenCV's YAML, as ROS and RTAB-Map write it."""
    with reading(path, "expected image_width, image_height and camera_matrix"):
        told = parse_yaml(re.sub(r"^%YAML.*|!!opencv-matrix", "", read_text(path)))
        size = int(told["image_width"]), int(told["image_height"])
        numbers = np.array(told["camera_matrix"]["data"], np.float64)
        if numbers.size != 9:  # as RTAB-Map wrote it until 2024
            numbers = np.reshape(told["projection_matrix"]["data"], (3, 4))[:, :3]
        bent = [float(value) for value in told.get("distortion_coefficients", {}).get("data", [])]
    lens = pinhole_lens(corner_origin(numbers.reshape(3, 3), what=str(path)), size)
    if not any(bent):
        return lens
    return LensParameters("FULL_OPENCV", (*lens.values, *bent, *[0.0] * (8 - len(bent))), size)


def corner_origin(K: ArrayLike, *, what: str) -> Float64:
    """(3, 3) of published intrinsics, whose first pixel centre is (0, 0), moved to (0.5, 0.5)."""
    matrix = np.array(K, np.float64)
    if matrix.shape == (4, 4):
        matrix = matrix[:3, :3]
    sound = matrix.shape == (3, 3) and np.isfinite(matrix).all() and min(np.diag(matrix)) > 0
    if (
        not sound
        or np.abs(matrix - pinhole(matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())).max() > 1e-6
    ):
        raise ProjectError(
            f"{what}: {matrix.tolist()}; expected [fx 0 cx; 0 fy cy; 0 0 1] with fx, fy > 0"
        )
    matrix[:2, 2] += 0.5
    return matrix


def pinhole_lens(K: ArrayLike, size: tuple[int, int]) -> LensParameters:
    """A pinhole camera without distortion of fx, fy, cx, cy, or a (3, 3) matrix without skew.

    ``size`` is width and height; all in pixels, the first pixel's centre is (0.5, 0.5).

    >>> pinhole_lens([500, 500, 320, 240], (640, 480)).values
    (500.0, 500.0, 320.0, 240.0)
    """
    matrix = np.asarray(K, np.float64)
    if matrix.ndim == 2:
        matrix = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    fx, fy, cx, cy = (float(value) for value in matrix)
    return LensParameters("PINHOLE", (fx, fy, cx, cy), (int(size[0]), int(size[1])))


def found_lens(values: object, size: tuple[int, int] | None, *shape: int) -> LensParameters | None:
    """As ``pinhole_lens`` has it of numbers of that shape, or four; None where they are none."""
    K = finite_array(values, *(shape or (4,)))
    return None if K is None or size is None else pinhole_lens(K, size)


def renderer_lens(values: Iterable[float], size: tuple[int, int]) -> LensParameters:
    """A renderer's camera of fx, fy, cx, cy, whichever way its data set counts pixels.

    It looks through the middle of its picture. So a principal point at ((W - 1) / 2, (H - 1) / 2)
    says that the first pixel's centre is meant to be (0, 0), and is moved by half a pixel; one at
    (W / 2, H / 2), or anywhere else, stays.

    >>> renderer_lens([725.0, 725.0, 620.5, 187.0], (1242, 375)).values
    (725.0, 725.0, 621.0, 187.5)
    """
    fx, fy, cx, cy = values
    if max(abs(cx - (size[0] - 1) / 2), abs(cy - (size[1] - 1) / 2)) < 0.01:
        cx, cy = cx + 0.5, cy + 0.5
    return pinhole_lens([fx, fy, cx, cy], size)


def scaled_lens(lens: LensParameters, size: tuple[int, int]) -> LensParameters:
    """The camera of the same picture resampled to ``size`` (width and height, pixels).

    >>> scaled_lens(pinhole_lens([500, 500, 320, 240], (640, 480)), (320, 240)).values
    (250.0, 250.0, 160.0, 120.0)
    """
    if tuple(size) == lens.size:
        return lens
    width, height = size
    camera = camera_of(lens.model, lens.values, lens.size, what="a picture's camera")
    camera.rescale(int(width), int(height))
    values = tuple(float(value) for value in camera.params)
    return LensParameters(lens.model, values, (int(width), int(height)))


# --- poses ------------------------------------------------------------------------------------


def quaternion_pose(wxyz: ArrayLike, translation: ArrayLike) -> Float64:
    """(4, 4) float64 of a quaternion, scalar first, and a translation; NaN where that is no pose.

    >>> quaternion_pose([1, 0, 0, 0], [1, 2, 3])[:3, 3]
    array([1., 2., 3.])
    """
    from scipy.spatial.transform import Rotation

    w, x, y, z = np.asarray(wxyz, np.float64)
    if not np.isfinite([w, x, y, z]).all() or w == x == y == z == 0:
        return np.full((4, 4), np.nan)
    return rigid_poses(Rotation.from_quat([x, y, z, w]).as_matrix(), translation)


def opencv_pose(world_from_cam: ArrayLike) -> Float64:
    """(4, 4) world_from_cam for OpenCV's camera axes, from (4, 4) or (3, 4) for OpenGL's."""
    pose = np.eye(4)
    pose[:3] = np.asarray(world_from_cam, np.float64)[:3]
    return pose @ OPENCV_FROM_OPENGL


def found_pose(values: object, *shape: int) -> Float64 | None:
    """As ``opencv_pose`` has it of numbers of that shape; None where they are none."""
    pose = finite_array(values, *shape)
    return None if pose is None else opencv_pose(pose)


def sky_findings(cam_from_world: Float64, axis: int) -> list[Finding]:
    """A line when the sky, along that axis of the world, is not to the top of most pictures."""
    up = cam_from_world[:, :2, axis].mean(axis=0)
    sky = max(DIRECTIONS, key=lambda name: float(up @ np.array(DIRECTIONS[name])))
    if sky == "up":
        return []
    line = f"the sky is to the {sky} of pictures: they are read as stored, not turned"
    return [Finding("info", line)]
