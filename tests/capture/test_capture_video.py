"""Frames of a video are picked by motion and sharpness."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from gvtools.capture.video import pick_frames
from gvtools.errors import OptionError, ProjectError

WIDTH, HEIGHT = 320, 240


@pytest.fixture(scope="module")
def wall() -> np.ndarray:
    """A long wall with corners everywhere."""
    rng = np.random.default_rng(0)
    small = rng.integers(0, 255, (HEIGHT // 8, 3 * WIDTH // 8, 3), np.uint8)
    return cv2.resize(small, (3 * WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def write_video(path: Path, frames: list[np.ndarray]) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25, (WIDTH, HEIGHT))
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


def test_frames_are_an_equal_motion_apart_and_sharp(tmp_path: Path, wall: np.ndarray) -> None:
    # The camera stands for 30 frames, then moves 8 pixels a frame; every third frame is blurred.
    at = [0] * 30 + [8 * i for i in range(60)]
    frames = [wall[:, x : x + WIDTH].copy() for x in at]
    frames = [cv2.GaussianBlur(f, (0, 0), 4) if i % 3 == 0 else f for i, f in enumerate(frames)]
    path = write_video(tmp_path / "walk.mp4", frames)
    picked = pick_frames(path, tmp_path / "frames", count=10, progress=lambda n: None)
    assert (picked.total, picked.lost) == (90, 0)
    assert picked.motion == pytest.approx(59 * 8 / WIDTH, rel=0.1)
    assert len(picked.frames) == 10
    assert all(frame % 3 for frame in picked.frames)
    steps = np.diff([at[frame] for frame in picked.frames])
    assert steps.max() <= 80  # two pieces of the path
    written = sorted(file.name for file in (tmp_path / "frames").iterdir())
    assert written == [f"frame_{frame:06d}.jpg" for frame in picked.frames]
    first = cv2.imread(str(tmp_path / "frames" / written[0]))
    assert first is not None
    assert np.abs(first.astype(int) - frames[picked.frames[0]]).mean() < 8


def test_a_video_without_motion_is_refused(tmp_path: Path, wall: np.ndarray) -> None:
    path = write_video(tmp_path / "still.mp4", [wall[:, :WIDTH].copy()] * 20)
    with pytest.raises(ProjectError, match="expected a camera that moves"):
        pick_frames(path, tmp_path / "frames", progress=lambda n: None)
    with pytest.raises(OptionError, match="expected 2 or more"):
        pick_frames(path, tmp_path / "frames", count=1, progress=lambda n: None)
