"""Other readings of pictures, under which they would fit what they stand for far better."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from gvtools.glb import srgb_bytes
from gvtools.scenes.scene import Frame

Picture = NDArray[np.float32]  # (H, W, 3), 0 to 255
Reading = Callable[[Picture], Picture]

# A reading explains pictures where it leaves at most this share of their squared errors (3 dB).
EXPLAINED = 0.5
# Channels of grey pictures differ by less on average, of 255.
GREY = 2
# Motion is fitted to pictures of this width, in at most so many steps or up to this change.
WIDTH, STEPS, CHANGE = 400, 60, 1e-5


def better_reading(pictures: Sequence[NDArray[np.uint8]], truths: Sequence[Frame]) -> str:
    """How pictures seem to be, other than they should be, all in one way; "" if nothing explains.

    Tried are mirrored and turned pictures, exchanged channels, negatives, linear light, one factor
    and offset of brightness, and one motion (shift, size, turn) in the picture.

    >>> truth = np.random.default_rng(0).integers(0, 255, (32, 32, 3), np.uint8)
    >>> better_reading([truth[::-1]], [Frame(truth)])[:48]
    'upside down: otherwise PSNR would be 98.1 dB ins'
    """
    pairs = [
        (picture.astype(np.float32), frame.rgb.astype(np.float32), frame.mask)
        for picture, frame in zip(pictures, truths, strict=True)
        if frame.mask is None or frame.mask.any()
    ]

    def errors(change: Reading) -> NDArray[np.float64]:
        changed = ((change(one).clip(0, 255) - other, mask) for one, other, mask in pairs)
        return np.array([np.square(x if m is None else x[m]).mean() for x, m in changed]) + 1e-5

    readings = dict(FIXED)
    moments = [[x.mean(), x.std(), y.mean(), y.std()] for x, y, _ in pairs]
    dark, narrow, mean, spread = np.median(moments, axis=0) if pairs else np.zeros(4)
    if narrow > 0:
        factor, offset = spread / narrow, mean - spread / narrow * dark
        name = f"of another brightness (fitting times {factor:.3g} {offset:+.3g} of 255)"
        readings[name] = lambda picture: factor * picture + offset
        readings |= _motion(pairs)
    elif pairs:
        return "of one colour alone"
    given = errors(lambda picture: picture)
    left = {name: np.median(errors(change) / given) for name, change in readings.items() if pairs}
    best = min(left, key=left.__getitem__, default="")
    # Of pictures that do not show their truths at all, none.
    if not best or left[best] > EXPLAINED or left[best] * np.median(given) > EXPLAINED * spread**2:
        vivid = [[np.ptp(x, axis=2).mean() for x in pair[:2]] for pair in pairs]
        grey = pairs and 5 * max(own for own, _ in vivid) < 5 * GREY < np.median(vivid, axis=0)[1]
        return "grey, where their views have colour" if grey else ""
    before, after = (-10 * np.log10(np.median(e) / 255**2) for e in (given, errors(readings[best])))
    return f"{best}: otherwise PSNR would be {min(after, 100):.1f} dB instead of {before:.1f}"


FIXED: dict[str, Reading] = {
    "mirrored left to right": lambda picture: picture[:, ::-1],
    "upside down": lambda picture: picture[::-1],
    "turned by 180 degrees": lambda picture: picture[::-1, ::-1],
    "of red and blue exchanged": lambda picture: picture[..., ::-1],
    "negatives": lambda picture: 255 - picture,
    "in linear light, without the curve of sRGB": lambda picture: srgb_bytes(picture / 255).astype(
        np.float32
    ),
}


def _motion(pairs: Sequence[tuple[Picture, Picture, object]]) -> dict[str, Reading]:
    """What undoes the motion that pictures have in common against their truths, by its name."""
    import cv2

    height, width = pairs[0][0].shape[:2]
    scale, found = min(1.0, WIDTH / width), []
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, STEPS, CHANGE)
    for one, other, _ in pairs:
        small = [cv2.resize(x, None, None, scale, scale, cv2.INTER_AREA) for x in (other, one)]
        first, second = (cv2.cvtColor(x, cv2.COLOR_RGB2GRAY) for x in small)
        start = np.eye(2, 3, dtype=np.float32)
        try:
            found.append(cv2.findTransformECC(first, second, start, cv2.MOTION_AFFINE, stop)[1])
        except cv2.error:  # the two have nothing in common
            continue
    if not found:
        return {}
    # Of pixels whose first centre is (0, 0), from the small pictures to the whole ones.
    motion = np.median(found, axis=0)
    motion[:, 2] = (motion[:, 2] + 0.5 - motion[:, :2].sum(axis=1) / 2) / scale
    motion[:, 2] += motion[:, :2].sum(axis=1) / 2 - 0.5
    middle = np.array([width - 1, height - 1]) / 2
    right, down = motion[:, :2] @ middle + motion[:, 2] - middle
    larger = np.sqrt(abs(np.linalg.det(motion[:, :2])))

    def undone(picture: Picture) -> Picture:
        flags, border = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_REPLICATE
        moved = cv2.warpAffine(picture, motion, (width, height), None, flags, border)
        return np.asarray(moved, np.float32)

    return {f"shifted ({right:.2g} right, {down:.2g} down) and {larger:.3g} times as large": undone}
