from __future__ import annotations

import numpy as np
import pytest
from scenes_workspace import PINHOLE, frame, ramp, save, transforms

from gvtools.scenes.inspection import inspect
from gvtools.scenes.transforms import read_transforms


def slanted(x: float) -> np.ndarray:
    """(72, 96) depth of a plane z = 2 + X / 4 seen from (x, 0, 0), scene units."""
    right = (np.arange(96) + 0.5 - 48) / 90
    return np.broadcast_to((2 + x / 4) / (1 - right / 4), (72, 96))


@pytest.mark.parametrize("lacking", [1, 1000, 0.001, 5, 0.2])
def test_depth_whose_unit_contradicts_the_poses(tmp_path, lacking):
    frames = []
    for i in range(6):
        save(tmp_path / f"images/{i}.png", ramp())
        np.save(tmp_path / f"{i}.npy", (slanted(0.2 * i) / lacking).astype(np.float32))
        one = frame(f"images/{i}.png", depth_file_path=f"{i}.npy", depth_unit_scale_factor=1.0)
        # The camera looks along +z of the world, right along its x.
        pose = np.diag([1.0, -1, -1, 1])
        pose[0, 3] = 0.2 * i
        frames.append({**one, "transform_matrix": pose.tolist()})
    found = inspect(read_transforms(transforms(tmp_path, frames, **PINHOLE))).findings
    warned = [item.message for item in found if "contradicts the poses" in item.message]
    assert len(warned) == (lacking != 1)
    if warned:
        times = float(warned[0].split("if depth were ")[1].split(" times")[0])
        assert times == pytest.approx(lacking, rel=0.15)
