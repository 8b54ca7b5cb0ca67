"""Photographs that are not what their cameras saw: renumbered, mirrored, cropped, turned.

Reprojection errors do not tell, as no pixel enters them. A track's detections show one place, so
that what photographs have there is alike: luminance at the detections of a view, freed of what
varies slowly, is correlated with the mean of the other views' at the same tracks.

Pictures that are all a little off (cropped, shifted, undistorted twice) still show alike places; so
places that are moved together are tried, too. The points' colours tell channels that are swapped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvtools.errors import GvError
from gvtools.scenes.matching import named
from gvtools.scenes.scene import Finding, Frame, Scene, SparsePoints

Grey = NDArray[np.float32]
Float64 = NDArray[np.float64]

# A view with so many tracks in common with others is judged, and disagrees below this correlation.
# On real scenes it is 0.92 and more, with noisy detections of fine texture 0.67; renumbered or
# mirrored it is 0.5 at most, and cropped by a tenth at each border 0.2 to 0.6 in the middle of a
# scene's views.
TRACKS, AGREE = 20, 0.65
# Pictures of a longer side below this many pixels have less detail: what they lack of it, times
# the second, is taken off.
SMALL, LESS = 200, 0.35
# Nothing is told by detail of a smaller deviation than this, grey levels.
CONTRAST = 2.0
# Detail is what a blur over this share of the longer side takes away.
BLUR = 1 / 40
# What sets wrong pictures right: that so many places after each, changed.
CHANGES: Mapping[str, tuple[int, Callable[[Grey], Grey]]] = {
    "they fit mirrored left to right": (0, lambda grey: grey[:, ::-1]),
    "they fit turned by half": (0, lambda grey: grey[::-1, ::-1]),
    "they fit turned upside down": (0, lambda grey: grey[::-1]),
    "they fit turned by a quarter": (0, np.rot90),
    "they fit turned by three quarters": (0, lambda grey: np.rot90(grey, -1)),
    "each fits the next picture": (1, np.asarray),
    "each fits the picture before it": (-1, np.asarray),
}
GIVE = "give the pictures that the poses were computed from"
# Views that a run looks at, and that a reason is sought for.
PROBES, TRIED = 8, 16
# How all detections may be moved: right and down in longer sides, from the middle in shares of the
# radius, of it by its square, of the width alone, and about the middle [radians], by these steps.
# On four real scenes no step gains more than 0.001; pictures shifted by a hundredth, cropped by
# 1.5 % or undistorted twice gain 0.03 and more.
_SIDE = "by {:+.1%} of the longer side"
MOVES = (f"shifted right {_SIDE}", f"shifted down {_SIDE}", "scaled by {:+.1%}",
         "bent by {:+.1%} in the corners", "wider by {:+.1%}",
         "turned by {:+.3f} radians")  # fmt: skip
MOVED_BY, GAIN, FITS = (0.04, 0.02, 0.01, 0.005, 0.0025), 0.02, 0.92
# By so many pixels on average, in so many views with so many detections each in common with others.
PIXELS, FEWEST, ENOUGH = 2.0, 4, 80
# Red less blue is judged where it deviates so much, and goes the other way below this correlation
# with the points'.
COLORED, SWAPPED = 4.0, -0.3
# Steps of one length at most, in a search for what fits better.
CLIMBS = 8

NO_POINTS = SparsePoints(
    np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32),
    np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 2)),
)  # fmt: skip


class PixelCheck:
    """The luminance at detections, gathered view by view."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.points = scene, scene.points or NO_POINTS
        self.rows = self.points.rows_of_views(len(scene))
        self.values = np.full(len(self.points.point_index), np.nan)
        self.kept = dict.fromkeys(self.most_in_common(range(len(scene))), np.zeros((0, 0), np.int8))
        self.swapped = dict[int, bool]()
        sides = [max(*view.camera.width, *view.camera.height) for view in scene.views]
        self.agree = AGREE - LESS * max(0, 1 - max(sides, default=SMALL) / SMALL)

    def most_in_common(self, numbers: Iterable[int]) -> list[int]:
        """The few views among ``numbers`` that have most tracks in common with one of them."""
        some = [number for number in numbers if len(self.rows[number])]
        if not some:
            return []
        index, seen = self.points.point_index, np.zeros(len(self.points.positions), np.bool_)
        seen[index[self.rows[max(some, key=lambda number: len(self.rows[number]))]]] = True
        return sorted(some, key=lambda number: -int(seen[index[self.rows[number]]].sum()))[:PROBES]

    def see(self, number: int, rgb: NDArray[np.uint8]) -> None:
        """Take in the photograph (H, W, 3) of a view."""
        if not len(self.rows[number]):
            return
        picture = shown(rgb)
        self.values[self.rows[number]] = self._at_detections(number, picture)
        if number in self.kept:
            self.kept[number] = np.rint(np.clip(picture, -127, 127)).astype(np.int8)
        own = self._at_detections(number, cv2.subtract(rgb[..., 0], rgb[..., 2], dtype=cv2.CV_32F))
        colors = self.points.colors[self.points.point_index[self.rows[number]]].astype(float)
        reds = np.stack([own, colors[:, 0] - colors[:, 2]])[:, np.isfinite(own)]
        if reds.shape[1] >= TRACKS and reds.std(axis=1).min() >= COLORED:
            self.swapped[number] = bool(np.corrcoef(reds)[0, 1] < SWAPPED)

    def _at_detections(
        self, number: int, picture: NDArray[Any], xy: Float64 | None = None
    ) -> Float64:
        """(N,) numbers of a picture at the detections of a view, or at other places of them."""
        return sampled(picture, self.points.xy[self.rows[number]] if xy is None else xy)

    def _places(self, number: int, move: Float64) -> Float64:
        """(N, 2) where the detections of a view are when they are moved, see MOVES."""
        height, width = self.kept[number].shape
        middle = np.array([width, height]) / 2
        off = self.points.xy[self.rows[number]] - middle
        radius = np.linalg.norm(off, axis=1, keepdims=True) / np.linalg.norm(middle)
        off = off * [1 + move[4], 1] + move[5] * off[:, ::-1] * [-1, 1]
        placed = middle + off * (1 + move[2] + move[3] * radius**2) + move[:2] * max(width, height)
        return np.asarray(placed)

    def _moved(self) -> str:
        """How all detections have to be moved for the photographs to agree better, "" for none."""
        known = [number for number, kept in self.kept.items() if kept.size]
        if len(known) < FEWEST:
            return ""
        # For each track another direction, the same in all views.
        turn, still = 2.4 * self.points.point_index, np.zeros(len(MOVES))
        ways = np.stack([np.cos(turn), np.sin(turn)], axis=1)

        def agreement(move: Float64, aside: float = 0.0) -> float:
            values = np.full(len(self.values), np.nan)
            for number in known:
                places = self._places(number, move) + aside * ways[self.rows[number]]
                values[self.rows[number]] = self._at_detections(number, self.kept[number], places)
            found = [*self.agreements(values, least=ENOUGH).values()]
            return float(np.median(found)) if len(found) >= FEWEST else -1.0

        if (now := agreement(still)) == -1:
            return ""
        best, move = climbed(agreement, still, MOVED_BY)
        away = np.concatenate([self._places(n, move) - self._places(n, still) for n in known])
        pixels = float(np.linalg.norm(away, axis=1).mean())
        # Where detections are noisy, places beside corners agree more than corners do.
        beside = agreement(still, max(pixels, PIXELS))
        if best < max(FITS, now + GAIN, beside + GAIN) or pixels < PIXELS:
            return ""
        way = ", ".join(MOVES[k].format(move[k]) for k in np.flatnonzero(move))
        return f"{way} against the detections (correlation {best:.2f} there, {now:.2f} at them)"

    def agreements(
        self,
        values: Float64 | None = None,
        *,
        without: Sequence[int] = (),
        least: int = TRACKS,
    ) -> dict[int, float]:
        """Correlation of each view with the others; none is compared with those ``without``."""
        values = self.values if values is None else values
        index, count = self.points.point_index, len(self.points.positions)
        known = np.isfinite(values)
        trusted = known & ~np.isin(self.points.view_index, list(without))
        total = np.bincount(index[trusted], values[trusted], count)
        views = np.bincount(index[trusted], minlength=count)
        found = {}
        for number, rows in enumerate(self.rows):
            own_share = trusted[rows]
            shared = rows[known[rows] & (views[index[rows]] > own_share)]
            own, at = values[shared], index[shared]
            if len(shared) >= least and own.std() >= CONTRAST:
                counted = trusted[shared]
                others = (total[at] - own * counted) / (views[at] - counted)
                found[number] = float(np.corrcoef(own, others)[0, 1])
        return found

    def findings(self) -> list[Finding]:
        """A warning where photographs and detections disagree."""
        judged = self.agreements()
        wrong = [n for n, s in judged.items() if s < self.agree]
        # Right ones that were compared with wrong ones are cleared.
        judged |= self.agreements(without=wrong)
        wrong = sorted((n for n in wrong if judged[n] < self.agree), key=lambda n: judged[n])
        findings = list[Finding]()
        if swapped := [n for n, turned in self.swapped.items() if turned and n not in wrong]:
            line = (
                f"{len(swapped)} of {len(self.swapped)} photographs have red and blue the other "
                f"way round than the points' colours, first {self.scene.views[swapped[0]].name}: "
                "give the pictures that the points were coloured from, or swap the channels"
            )
            findings.append(Finding("warning", line))
        moved = self._moved()
        if not wrong:
            if moved:
                findings.append(Finding("warning", f"photographs are {moved}: {GIVE}"))
            return findings
        names = named([f"{self.scene.views[n].name} ({judged[n]:.2f})" for n in wrong])
        message = (
            f"{len(wrong)} of {len(judged)} photographs do not show what their cameras saw "
            f"({len(wrong) / len(judged):.0%}; correlation at detections below {self.agree:.2g}): "
            f"{names}{self._reason(wrong) or (moved and f'; they are {moved}')}; renumbered, "
            f"mirrored, cropped or turned pictures give wrong results: {GIVE}"
        )
        return [*findings, Finding("warning", message)]

    def _reason(self, wrong: Sequence[int]) -> str:
        """What would make wrong pictures agree, "" where nothing that is tried does."""
        chosen, pictures = wrong[:TRIED], dict[int, Grey]()
        for number in {n + step for n in chosen for step in (-1, 0, 1)} & {*range(len(self.rows))}:
            if frame := frame_there(self.scene, number):
                pictures[number] = shown(frame.rgb)
        for reason, (step, change) in CHANGES.items():
            values = self.values.copy()
            for number in wrong:
                values[self.rows[number]] = np.nan
                grey = pictures.get(number + step)
                if number in chosen and grey is not None and change(grey).shape == grey.shape:
                    values[self.rows[number]] = self._at_detections(number, change(grey))
            scores = self.agreements(values)
            fit = [scores[number] for number in chosen if number in scores]
            if fit and np.median(fit) > self.agree:
                return f"; {reason}"
        return ""


def shown(rgb: NDArray[np.uint8]) -> Grey:
    """(H, W) detail, as it is compared: of three by three pixels, without bands of light."""
    found = np.asarray(cv2.blur(detail(rgb), (3, 3)), np.float32)
    return np.asarray(found - found.mean(1, keepdims=True))


def detail(rgb: NDArray[np.uint8]) -> Grey:
    """(H, W) luminance without what varies slowly."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    sigma, size = BLUR * max(grey.shape), grey.shape[::-1]
    # A wide blur is the same, and many times as quick, of a picture reduced to its own detail.
    factor = max(1, int(sigma / 4))
    reduced = (max(1, size[0] // factor), max(1, size[1] // factor))
    small = cv2.resize(grey, reduced, interpolation=cv2.INTER_AREA)
    slow = cv2.resize(cv2.GaussianBlur(small, (0, 0), sigma / factor), size)
    return np.asarray(grey - slow, np.float32)


def probed(scene: Scene, names: Sequence[str]) -> list[Finding]:
    """The findings of a few views among ``names`` that have most tracks in common."""
    check = PixelCheck(scene)
    numbers = [number for number, view in enumerate(scene.views) if view.name in set(names)]
    check.kept = dict.fromkeys(check.most_in_common(numbers), np.zeros((0, 0), np.int8))
    for number in check.kept:
        check.see(number, scene.views[number].load().rgb)
    return check.findings()


def climbed(
    score: Callable[[Float64], float], start: Float64, steps: Sequence[float], *, gain: float = 0.0
) -> tuple[float, Float64]:
    """The best score and its place: ever smaller steps along an axis, each worth a gain."""
    best, place = score(start), start
    for step in steps:
        for _ in range(CLIMBS):
            tried = [place + way * step for unit in np.eye(len(place)) for way in (unit, -unit)]
            scores = [score(other) for other in tried]
            if max(scores) <= best + gain:
                break
            best, place = max(scores), tried[int(np.argmax(scores))]
    return best, place


def sampled(picture: NDArray[Any], xy: Float64, *of: NDArray[np.int64]) -> Float64:
    """(N,) numbers of (..., H, W) pictures, ``of`` which, at places (N, 2); NaN outside."""
    with np.errstate(invalid="ignore"):
        inside = ((xy >= 0) & (xy < picture.shape[:-3:-1])).all(1)
    x, y = np.floor(xy[inside]).astype(np.int64).T
    found = np.full(len(xy), np.nan)
    found[inside] = picture[(*(each[inside] for each in of), y, x)]
    return found


def frame_there(scene: Scene, number: int) -> Frame | None:
    """A view's pixels; None where they cannot be read, which is said elsewhere."""
    try:
        return scene.views[number].load()
    except GvError:
        return None
