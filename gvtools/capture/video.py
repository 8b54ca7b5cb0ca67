"""Frames of a video that structure from motion can use: sharp ones, a fair step apart."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvtools.capture.photographs import JPEG_QUALITY, sharpness
from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.scene import Finding
from gvtools.untrusted import regular

# Frames are compared at this width. [pixels]
WIDTH = 320
# Motion, as a share of the picture's width, after which a frame is taken where no number is given:
# neighbours then share nine tenths of what they show.
STEP = 0.07
MOST = 300
# A whole video with less motion than this share of the width shows the scene from one place.
STANDS_STILL = 0.05
# Containers' counts of frames are not exact; this share may lack without a word.
LOST = 0.05
# Corners (Shi-Tomasi) that are tracked from frame to frame, at most.
CORNERS = 200


@dataclass(frozen=True)
class FrameSelection:
    """What was taken from a video."""

    frames: tuple[int, ...]  # numbers of the frames taken, from 0
    total: int  # how many frames it has
    motion: float  # of the whole video, in widths of the picture
    # How many frames the file announces beyond those that can be read; 0 where they are fewer
    # than LOST of all.
    lost: int = 0

    def findings(self, name: str) -> list[Finding]:
        """For the report of the capture of a video of that name."""
        text = (
            f"{len(self.frames)} of {self.total} frames taken, over a motion of "
            f"{self.motion:.1f} widths of the picture"
        )
        lost = (
            f"{name}: about {self.lost} frames at its end cannot be read; copy the video again if "
            "it was cut off"
        )
        return [Finding("info", text), *([Finding("warning", lost)] if self.lost else ())]


def pick_frames(
    path: Path, folder: Path, *, count: int | None = None, progress: Callable[[int], object]
) -> FrameSelection:
    """Write the chosen frames of a video to ``folder`` as ``frame_NNNNNN.jpg``.

    The path of the picture is cut into pieces of equal motion, and the sharpest frame of each is
    taken; without a count there is one a STEP of motion, MOST at most.
    """
    if count is not None and count < 2:
        raise OptionError(f"--frames {count}; expected 2 or more")
    moved, sharp, announced = _measure(path, progress)
    total = float(moved[-1])
    if len(moved) < 2 or total < STANDS_STILL:
        raise ProjectError(
            f"{path}: its {len(moved)} frames move by {total:.1%} of the picture's width in all; "
            "expected a camera that moves; film the scene while walking"
        )
    pieces = count or int(np.clip(round(total / STEP), 8, MOST))
    pieces = min(pieces, len(moved))
    piece = np.minimum((moved / total * pieces).astype(int), pieces - 1)
    chosen = []
    for number in np.unique(piece):
        rows = np.flatnonzero(piece == number)
        chosen.append(int(rows[np.argmax(sharp[rows])]))
    _write(path, folder, chosen)
    lost = announced - len(moved)
    return FrameSelection(tuple(chosen), len(moved), total, lost if lost > LOST * announced else 0)


def _measure(
    path: Path, progress: Callable[[int], object]
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """(N,) motion up to each frame, in widths, (N,) sharpness of each, and N as announced."""
    try:
        size = regular(path).stat().st_size
    except OSError as error:
        raise ProjectError(f"{path}: {error.strerror or error}; expected a video") from None
    # What FFmpeg says of a damaged file is said by the errors here, in words that help.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise ProjectError(
            f"{path}: no video that OpenCV reads ({size} bytes); it may have been "
            "cut off: copy it again, or convert it to H.264 in MP4"
        )
    moved, sharp = [0.0], []
    before: NDArray[Any] | None = None
    while True:
        there, frame = video.read()
        if not there:
            break
        height = max(1, round(frame.shape[0] * WIDTH / frame.shape[1]))
        grey = cv2.cvtColor(
            cv2.resize(frame, (WIDTH, height), interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY
        )
        sharp.append(sharpness(grey))
        if before is not None:
            moved.append(moved[-1] + _motion(before, grey))
        before = grey
        if len(sharp) % 100 == 0:
            progress(len(sharp))
    announced = int(max(0.0, video.get(cv2.CAP_PROP_FRAME_COUNT)))
    video.release()
    if not sharp:
        raise ProjectError(f"{path}: a video without a frame that can be read")
    return np.array(moved), np.array(sharp), announced


def _motion(before: NDArray[Any], now: NDArray[Any]) -> float:
    """Median motion of corners between two frames, in widths of the picture."""
    corners = cv2.goodFeaturesToTrack(before, CORNERS, 0.01, 5)
    if corners is None or len(corners) < 8:
        return 0.0
    found, there, _ = cv2.calcOpticalFlowPyrLK(before, now, corners, np.empty_like(corners))
    kept = there[:, 0] == 1
    if kept.sum() < 8:
        # Nothing of the one is found in the other: as far apart as can be measured.
        return STEP
    return float(np.median(np.linalg.norm((found - corners)[kept, 0], axis=1))) / before.shape[1]


def _write(path: Path, folder: Path, chosen: list[int]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    video, wanted, number = cv2.VideoCapture(str(path)), set(chosen), 0
    while wanted:
        # Frames in between are decoded, not copied out.
        if not video.grab():
            break
        if number in wanted:
            _, frame = video.retrieve()
            name = str(folder / f"frame_{number:06d}.jpg")
            if not cv2.imwrite(name, frame, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]):
                raise ProjectError(f"{name}: cannot be written; free some space")
            wanted.remove(number)
        number += 1
    video.release()
