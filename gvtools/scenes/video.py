"""Single frames of a video file, through PyAV."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.optional import require
from gvtools.scenes.scene import Frame
from gvtools.untrusted import reading, regular


@dataclass(frozen=True)
class VideoHeader:
    """Size and length of a video."""

    size: tuple[int, int]  # width and height, pixels
    seconds: float  # infinity where the file does not say
    frame_seconds: float  # from one frame to the next, on average


def video_header(path: Path) -> VideoHeader:
    """Size and length of a video; nothing is decoded."""
    with _opened(path) as container:
        stream = container.streams.video[0]
        seconds = np.inf
        if stream.duration is not None:
            seconds = float(stream.duration * stream.time_base)
        elif container.duration is not None:
            seconds = container.duration / 1e6
        rate = stream.average_rate or stream.guessed_rate or 30
        if min(stream.width, stream.height) < 1:
            raise ProjectError(f"{path}: pictures of no size; expected a video; copy it again")
        return VideoHeader((stream.width, stream.height), seconds, float(1 / rate))


def frame_seconds(path: Path, *, edits: bool = True) -> NDArray[np.float64]:
    """(N,) seconds of all frames in order; with ``edits``, without those of the edit list."""
    with _reading(path), _opened(path, edits=edits) as container:
        stream = container.streams.video[0]
        ticks = sorted(
            packet.pts
            for packet in container.demux(stream)
            if packet.pts is not None and not packet.is_discard
        )
        begin = stream.start_time or 0
        return (np.array(ticks, np.float64) - begin) * float(stream.time_base)


def read_frame(path: Path, *, seconds: float, edits: bool = True) -> Frame:
    """The frame whose time stamp is nearest, in seconds from the video's beginning."""
    best, best_off = None, np.inf
    with _reading(path, f" at {seconds:.3f} s"), _opened(path, edits=edits) as container:
        stream = container.streams.video[0]
        begin = (stream.start_time or 0) * stream.time_base
        target = round((seconds + float(begin)) / float(stream.time_base))
        container.seek(max(target, 0), stream=stream, backward=True)
        for frame in container.decode(stream):
            if frame.pts is None:
                continue
            off = abs(frame.pts - target)
            if off >= best_off:
                break
            best, best_off = frame, off
        else:
            # The last frame stands for its own time alone, or a copy that was cut off would give
            # it for all that is missing.
            rate = stream.average_rate or stream.guessed_rate or 30
            if best is not None and best_off * stream.time_base > 0.75 / float(rate):
                best = None
        if best is None:
            raise ValueError("no frame")
        return Frame(np.ascontiguousarray(best.to_ndarray(format="rgb24")))


def _opened(path: Path, *, edits: bool = True) -> Any:
    with _reading(path):
        # Text of the file's own, which may be no UTF-8, is not looked at.
        container = _av().open(
            str(regular(path)),
            options={} if edits else {"ignore_editlist": "1"},
            metadata_errors="replace",
        )
    streams = container.streams.video
    if not streams or streams[0].codec_context is None:
        container.close()
        what = "whose codec is not known" if streams else "without video stream"
        raise ProjectError(f"{path}: a file {what}; expected a video")
    return container


def _reading(path: Path, place: str = "") -> AbstractContextManager[None]:
    errors = (_av().error.FFmpegError,)
    return reading(f"{path}{place}", "expected a whole video; copy it again", also=errors)


def _av() -> Any:
    return require(
        "av", extra="data", purpose="reading a video", instead="or give frames as pictures"
    )
