"""LZF, which PCD packs points with, unpacked piece by piece: memory does not grow with the points.

A control byte below 32 is followed by that many bytes and one more. Any other begins a copy of what
was unpacked before: its upper three bits are the length less 2 (7: a further byte is added), its
lower five and the last byte how far back it begins, less 1.
"""

from __future__ import annotations

from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.kernels import compiled

# How far back copies begin at most, and the longest output of one control byte.
WINDOW, LONGEST = 1 << 13, 264
PIECE = 1 << 20


def unpack(packed: NDArray[np.uint8], out: IO[bytes]) -> int:
    r"""Write what ``packed`` holds; returns how many bytes these are.

    >>> import io
    >>> unpacked = io.BytesIO()
    >>> unpack(np.frombuffer(b"\x01ab\x40\x01", np.uint8), unpacked), unpacked.getvalue()
    (6, b'ababab')
    """
    piece = np.zeros(WINDOW + PIECE + LONGEST, np.uint8)
    total = at = 0
    while at < len(packed):
        at, end = _piece(packed, at, piece, min(total, WINDOW))
        if at < 0:
            raise ValueError("damaged compressed points")
        out.write(piece[WINDOW:end].data)
        total += end - WINDOW
        # The end of one piece is what the next one copies from.
        piece[:WINDOW] = piece[end - WINDOW : end].copy()
    return total


@compiled()
def _piece(packed: Any, at: int, out: Any, before: int) -> tuple[int, int]:
    """Unpack from ``at`` until ``out`` is nearly full; where both end, or -1 where damaged.

    ``out`` begins with a window, of which the last ``before`` bytes were unpacked earlier.
    """
    end, first, count = WINDOW, WINDOW - before, len(packed)
    while at < count and end < WINDOW + PIECE:
        control = int(packed[at])
        at += 1
        if control < 32:
            length = control + 1
            if at + length > count:
                return -1, 0
            for k in range(length):
                out[end + k] = packed[at + k]
            at += length
        else:
            length = control >> 5
            if length == 7:
                if at >= count:
                    return -1, 0
                length += int(packed[at])
                at += 1
            if at >= count:
                return -1, 0
            source = end - ((control & 31) << 8) - int(packed[at]) - 1
            at += 1
            length += 2
            if source < first:
                return -1, 0
            for k in range(length):
                out[end + k] = out[source + k]
        end += length
    return at, end
