"""A trajectory of ten thousand frames opens and streams in little memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from data_sets.room_frames import rendered_frames
from PIL import Image

FRAMES = 10_000
OPENED_MB = 80  # more than before it was opened, after opening
STREAMED_MB = 20  # and more than that, after every frame was loaded

# Opens the scene, then loads every frame of it; prints peaks of resident memory in MB, and how many
# seconds the processor took.
SCRIPT = """
import json, sys, time
from pathlib import Path
from data_sets.miniature import read_miniature

def peak():
    (line,) = [x for x in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in x]
    return int(line.split()[1]) / 1024

root, first, scene = Path(sys.argv[1]), *sys.argv[2:]
read_miniature("tartanair", root, first).views[0].load()  # everything is imported now
start, before = time.process_time(), peak()
opened = read_miniature("tartanair", root, scene)
seconds, after = time.process_time() - start, peak()
total = sum(int(frame.rgb[0, 0, 0]) + int(frame.depth is not None) for frame in
            (view.load() for view in opened))
print(json.dumps(dict(count=len(opened), total=total, before=before, opened=after, end=peak(),
                      seconds=seconds, all=time.process_time() - start)))
"""


def write_trajectory(folder: Path, frames: int) -> int:
    """One picture and one depth map under ``frames`` names each; the picture's first value."""
    drawn = rendered_frames((32.0, 32.0, 32.0, 24.0), 64, 48)
    for name in ("image_left", "depth_left"):
        (folder / name).mkdir(parents=True)
    image, depth = folder / "picture.png", folder / "depth.npy"
    Image.fromarray(drawn.rgb[0]).save(image)
    np.save(depth, drawn.depth[0])
    for i in range(frames):
        os.link(image, folder / "image_left" / f"{i:06d}_left.png")
        os.link(depth, folder / "depth_left" / f"{i:06d}_left_depth.npy")
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (frames, 1))
    poses[:, 0] = np.arange(frames)
    np.savetxt(folder / "pose_left.txt", poses)
    return int(drawn.rgb[0, 0, 0, 0])


@pytest.mark.slow
def test_ten_thousand_frames_stream(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_trajectory(tmp_path / "small" / "Easy" / "P000", 2)
    value = write_trajectory(tmp_path / "large" / "Easy" / "P000", FRAMES)
    command = [sys.executable, "-c", SCRIPT, str(tmp_path)]
    scenes = ["small/Easy/P000/left", "large/Easy/P000/left"]
    folders = [str(Path(__file__).parents[3]), str(Path(__file__).parents[2] / "fixtures")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(folders)}
    done = subprocess.run(
        [*command, *scenes], env=environment, capture_output=True, text=True, check=True
    )
    told = json.loads(done.stdout)
    with capsys.disabled():
        print("\n", {key: round(number, 1) for key, number in told.items()})
    assert told["count"] == FRAMES
    assert told["total"] == FRAMES * (value + 1)
    assert told["opened"] - told["before"] < OPENED_MB
    assert told["end"] - told["opened"] < STREAMED_MB
