from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scenes_workspace import PINHOLE, frame, ramp, save, transforms

from gvtools.scenes.inspection import inspect
from gvtools.scenes.transforms import read_transforms

FOCAL = 45
X, Y = np.meshgrid((np.arange(96) + 0.5 - 48) / FOCAL, (np.arange(72) + 0.5 - 36) / FOCAL)


def place(i: int) -> float:
    """Where the camera of a frame is along x, scene units: it does not go evenly."""
    return 0.2 * i + -0.06 * (i % 2)


def slanted(i: int) -> np.ndarray:
    """(72, 96) depth of a plane z = 2 + X / 4, scene units."""
    return (2 + place(i) / 4) / (1 - X / 4)


def slats(i: int) -> np.ndarray:
    """(72, 96) depth of slats at z = 1.2 before a wall at z = 2."""
    return np.where(np.floor((place(i) + 1.2 * X) * 4) % 2, 1.2, 2.0)


def warned(root: Path, depth_of: Callable[[int], np.ndarray]) -> list[str]:
    """What a check of six views says of their depth."""
    frames = []
    for i in range(6):
        save(root / f"images/{i}.png", ramp())
        np.save(root / f"{i}.npy", depth_of(i).astype(np.float32))
        one = frame(f"images/{i}.png", depth_file_path=f"{i}.npy", depth_unit_scale_factor=1.0)
        # The camera looks along +z of the world, right along its x.
        pose = np.diag([1.0, -1, -1, 1])
        pose[0, 3] = place(i)
        frames.append({**one, "transform_matrix": pose.tolist()})
    lens = {**PINHOLE, "fl_x": FOCAL, "fl_y": FOCAL}
    found = inspect(read_transforms(transforms(root, frames, **lens))).findings
    return [item.message for item in found if "contradicts the poses" in item.message]


@pytest.mark.parametrize("lacking", [1, 1.05, 1.2, 0.8, 1000, 0.001, 5])
def test_depth_whose_unit_contradicts_the_poses(tmp_path, lacking):
    said = warned(tmp_path, lambda i: slanted(i) / lacking)
    assert len(said) == (abs(lacking - 1) > 0.1)
    if said:
        times = float(said[0].split("if depth were ")[1].split(" times")[0])
        assert times == pytest.approx(lacking, rel=0.15)


@pytest.mark.parametrize(
    ("depth_of", "reason"),
    [
        (slats, ""),
        (lambda i: slanted(i)[:, ::-1], "mirrored"),
        (lambda i: slanted(20 * (i % 3)), "of other frames"),
        (lambda i: slats(i + 1), "fits the frame after its own"),
        (lambda i: slanted(i) * np.sqrt(1 + X**2 + Y**2), "as distances along the rays"),
    ],
)
def test_depth_of_other_frames_or_cameras(tmp_path, depth_of, reason):
    assert [reason in line for line in warned(tmp_path, depth_of)] == [True] * bool(reason)
