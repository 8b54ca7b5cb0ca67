"""Waymo Open, perception data set v2: Parquet components, one file a segment.

``[SPLIT/]camera_image/SEGMENT.parquet`` holds JPEGs with the vehicle's pose at each picture's own
time, ``camera_calibration`` a row for each of the five cameras, ``vehicle_pose`` the pose of each
frame, which stands in where a picture lacks its own. Both are world_from_vehicle; ``extrinsic`` is
vehicle_from_cam of a camera with x forward, y left and z up; units are metres. Lenses have OpenCV's
k1, k2, p1, p2, k3 and are undistorted. Columns of numbers are read at opening; a picture is read
from its row group when it is needed. Lidar is not read, and shutters roll: a picture has one pose.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gvtools.optional import require
from gvtools.scenes.calibration import Float64
from gvtools.scenes.images import decode_picture
from gvtools.scenes.layout import Layout
from gvtools.scenes.matching import natural
from gvtools.scenes.photographs import PosedFrame, posed_scene
from gvtools.scenes.scene import Frame, Scene, counted
from gvtools.scenes.undistort import LensParameters
from gvtools.untrusted import reading, regular

CAMERAS = {1: "front", 2: "front_left", 3: "front_right", 4: "side_left", 5: "side_right"}
TIME, CAMERA = "key.frame_timestamp_micros", "key.camera_name"
IMAGE, IMAGE_POSE = "[CameraImageComponent].image", "[CameraImageComponent].pose.transform"
VEHICLE_POSE = "[VehiclePoseComponent].world_from_vehicle.transform"
CALIBRATION = "[CameraCalibrationComponent]."
INTRINSICS = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
# Waymo's camera axes (x forward, y left, z up) from OpenCV's.
WAYMO_FROM_OPENCV = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
PICTURES_AT_ONCE = 4  # that are decoded from a row group to come to one of them
ROWS_AT_ONCE = 1024  # of numbers


def _scenes(root: Path) -> tuple[str, ...]:
    files = (*root.glob("camera_image/*.parquet"), *root.glob("*/camera_image/*.parquet"))
    found = []
    for path in files:
        split = path.parent.parent.relative_to(root).as_posix()
        found.append(path.stem if split == "." else f"{split}/{path.stem}")
    return natural(found)


@Layout.of_reader(
    "SPLIT/camera_image/SEGMENT.parquet with camera_calibration and vehicle_pose", _scenes
)
def _waymo(root: Path, scene: str) -> Scene:
    split, _, segment = scene.rpartition("/")
    home = root / split
    images = home / "camera_image" / f"{segment}.parquet"
    rig = _calibrations(home / "camera_calibration" / f"{segment}.parquet")
    vehicle = _vehicle_poses(home / "vehicle_pose" / f"{segment}.parquet")
    pictures, stood_in = [], 0
    for group, row, record in _rows(images, (TIME, CAMERA, IMAGE_POSE)):
        time, camera = int(record[TIME]), int(record[CAMERA])
        pose = _transform(record.get(IMAGE_POSE))
        if pose is None:
            pose = vehicle.get(time)
            stood_in += pose is not None
        lens, vehicle_from_cam = rig.get(camera, (None, None))
        if pose is not None and vehicle_from_cam is not None:
            pose = pose @ vehicle_from_cam @ WAYMO_FROM_OPENCV
        name, read = CAMERAS.get(camera, camera), partial(read_picture, group=group, row=row)
        pictures.append(PosedFrame(f"{name}/{time}", images, lens, pose, read=read))
    findings = counted(stood_in, "pictures have their frame's pose, not that of their own time")
    return posed_scene(images, pictures, poses="world_from_cam", metric=True, findings=findings)


def read_picture(path: Path, *, group: int, row: int) -> Frame:
    """The picture in a row of a row group of a ``camera_image`` file."""
    with reading(path), _parquet().ParquetFile(regular(path)) as file:
        for batch in file.iter_batches(
            batch_size=PICTURES_AT_ONCE, row_groups=[group], columns=[IMAGE]
        ):
            if row < batch.num_rows:
                data = batch.column(0)[row].as_py()
                return decode_picture(data, where=f"{path}, row {row} of group {group}")
            row -= batch.num_rows
        raise ValueError(f"no such row in row group {group}")


def _rows(path: Path, columns: tuple[str, ...]) -> Iterator[tuple[int, int, dict[str, Any]]]:
    """Row group, row within it, and the values of the columns that a file has."""
    advice = "expected a Parquet file; copy it again"
    with reading(path, advice), _parquet().ParquetFile(regular(path)) as file:
        known = set(file.schema_arrow.names)
        wanted = [name for name in columns if name in known]
        if lost := {CAMERA, TIME}.intersection(columns) - known:
            raise ValueError(f"without the column {min(lost)}")
        for group in range(file.num_row_groups):
            row = 0
            for batch in file.iter_batches(
                batch_size=ROWS_AT_ONCE, row_groups=[group], columns=wanted
            ):
                for record in batch.to_pylist():
                    yield group, row, record
                    row += 1


def _calibrations(path: Path) -> dict[int, tuple[LensParameters, Float64 | None]]:
    """For each camera its lens and (4, 4) vehicle_from_cam."""
    names = [f"{CALIBRATION}intrinsic.{name}" for name in INTRINSICS]
    sides = [f"{CALIBRATION}{side}" for side in ("width", "height")]
    extrinsic = f"{CALIBRATION}extrinsic.transform"
    rig = {}
    for _, _, record in _rows(path, (CAMERA, *names, *sides, extrinsic)):
        try:
            *shared, k3 = (float(record[name]) for name in names)
            size = int(record[sides[0]]), int(record[sides[1]])
        except (KeyError, OverflowError, TypeError, ValueError):
            continue  # a camera without intrinsics: its pictures are left out and counted
        lens = LensParameters("FULL_OPENCV", (*shared, k3, 0.0, 0.0, 0.0), size)
        rig[int(record[CAMERA])] = lens, _transform(record.get(extrinsic))
    return rig


def _vehicle_poses(path: Path) -> dict[int, Float64]:
    """For each frame's time stamp (4, 4) world_from_vehicle; empty where the file is absent."""
    if not path.is_file():
        return {}
    poses = {}
    for _, _, record in _rows(path, (TIME, VEHICLE_POSE)):
        pose = _transform(record.get(VEHICLE_POSE))
        if pose is not None:
            poses[int(record[TIME])] = pose
    return poses


def _transform(values: Any) -> Float64 | None:
    """(4, 4) of sixteen numbers, row by row; None where there are none."""
    if values is None or len(values) != 16:
        return None
    return np.array(values, np.float64).reshape(4, 4)


def _parquet() -> Any:
    return require("pyarrow.parquet", extra="data", purpose="reading Waymo's files")


LAYOUTS = (_waymo,)
