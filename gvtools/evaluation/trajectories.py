"""Pose errors of an estimated trajectory: association, ATE, RPE, pose AUC, wrong conventions.

ATE and RPE follow J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS
2012, with the conventions of evo: the estimate is aligned to the reference by its camera centres;
the absolute error is taken pose by pose, the relative one between poses a number of frames apart.
Poses are camera-to-world, (N, 4, 4) float64. What the data do not determine has a status and no
number.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations, product, starmap

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.cameras import ROTATION_TOLERANCE, invert_rigid
from gvtools.errors import DegenerateError, OptionError, ShapeError
from gvtools.evaluation.statistics import ErrorStatistics
from gvtools.scenes.matching import paired
from gvtools.similarity import COINCIDENT, SimilarityFit, fit_line, fit_similarity

Float64 = NDArray[np.float64]

ALIGNMENTS = ("none", "se3", "sim3")
AUC_THRESHOLDS = (3.0, 5.0, 10.0, 30.0)
AUC_BINS = 1000
ALIGNED = "aligned"
UNALIGNED = "not aligned"
ON_LINE = "aligned along a line"
# A step below this share of the extent is none.
STILL = 1e-12


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseErrors:
    """Errors of an estimated trajectory; without figures they are None."""

    # "aligned", "not aligned" (none was asked for or needed), "aligned along a line" (whose
    # rotation is open, so that ATE has none), or "degenerate: ..." with why there are no figures.
    status: str
    translation: ErrorStatistics | None = None  # scene units of the reference
    # The same, divided by ``extent``; None also when the extent is 0.
    translation_share: ErrorStatistics | None = None
    rotation_deg: ErrorStatistics | None = None  # degrees
    scale: float | None = None  # reference units per unit of the estimate; 1 where not fitted
    extent: float  # twice the largest distance of a reference centre from their mean, scene units
    translation_errors: Float64 = field(default_factory=lambda: np.zeros(0))  # (N,), pose or pair
    rotation_errors_deg: Float64 = field(default_factory=lambda: np.zeros(0))  # (N,), likewise

    @property
    def ok(self) -> bool:
        """Whether there are figures."""
        return self.translation is not None


def absolute_errors(
    reference: ArrayLike,
    estimate: ArrayLike,
    *,
    align: str = "sim3",
    refuse_mirrored: bool = True,
) -> PoseErrors:
    """Absolute trajectory error (ATE): how far each pose is off after one alignment.

    Args:
        reference: (N, 4, 4) world_from_cam, scene units.
        estimate: (N, 4, 4), row by row the same cameras.
        align: "none", "se3" or "sim3".
        refuse_mirrored: refuse an estimate that fits the reference's mirror image far better.
            No rotation mends that, so the best one is reported with False.

    Raises:
        ShapeError: wrong shapes, no rotations, or values that are not finite.
        OptionError: an unknown alignment.

    >>> import numpy as np
    >>> reference = np.tile(np.eye(4), (4, 1, 1))
    >>> reference[:, :3, 3] = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 1]]
    >>> estimate = reference.copy()
    >>> estimate[:, :3, 3] *= 0.5  # the same path at half the scale
    >>> errors = absolute_errors(reference, estimate, align="sim3")
    >>> errors.status, round(errors.scale, 6), round(errors.translation.rmse, 6)
    ('aligned', 2.0, 0.0)
    """
    first, second = _poses(reference, estimate)
    status, fit = _aligned(first, second, align, refuse_mirrored=refuse_mirrored)
    extent = center_extent(first)
    if not (status in (ALIGNED, UNALIGNED, ON_LINE) and len(first)):
        return PoseErrors(status=status, extent=extent)
    centers, rotations = second[:, :3, 3], second[:, :3, :3]
    if fit is not None and status == ON_LINE:
        translation = fit.residuals
    elif fit is not None:
        # Residuals are taken about the centroids, so that great offsets keep their digits.
        translation, rotations = fit.residuals, fit.rotation @ rotations
    else:
        translation = np.linalg.norm(centers - first[:, :3, 3], axis=1)
    rotation = _angles_deg(np.swapaxes(first[:, :3, :3], 1, 2) @ rotations)
    rotation = np.zeros(0) if status == ON_LINE else rotation
    return _figures(status, translation, rotation, extent=extent, fit=fit)


def relative_errors(
    reference: ArrayLike,
    estimate: ArrayLike,
    *,
    align: str = "sim3",
    delta: int = 1,
    all_pairs: bool = False,
    refuse_mirrored: bool = True,
) -> PoseErrors:
    """Relative pose error (RPE): how far the motion over ``delta`` frames is off.

    Of the alignment, only the scale matters here.

    Args:
        reference: (N, 4, 4) world_from_cam, scene units.
        estimate: (N, 4, 4), row by row the same cameras.
        align: "none", "se3" or "sim3".
        delta: frames from the first pose of a pair to the second.
        all_pairs: pairs start at every frame; otherwise each starts where the last one ended.
        refuse_mirrored: as of ``absolute_errors``.

    Raises:
        ShapeError: wrong shapes, no rotations, or values that are not finite.
        OptionError: an unknown alignment, or a delta below 1.

    >>> import numpy as np
    >>> reference = np.tile(np.eye(4), (5, 1, 1))
    >>> reference[:, 0, 3] = np.arange(5)  # one unit a frame
    >>> estimate = reference.copy()
    >>> estimate[:, 0, 3] *= 1.1
    >>> errors = relative_errors(reference, estimate, align="none")
    >>> round(errors.translation.mean, 6), errors.translation.n
    (0.1, 4)
    """
    if delta < 1:
        raise OptionError(f"RPE delta {delta}; expected 1 frame or more")
    first, second = _poses(reference, estimate)
    status, fit = _aligned(first, second, align, refuse_mirrored=refuse_mirrored)
    if align == "se3" and "mirror image of" not in status and len(first):
        status, fit = (status, fit) if status == ALIGNED else (UNALIGNED, None)
    extent = center_extent(first)
    start = np.arange(0, max(len(first) - delta, 0), 1 if all_pairs else delta)
    if status not in (ALIGNED, UNALIGNED, ON_LINE):
        return PoseErrors(status=status, extent=extent)
    if not len(start):
        status = f"degenerate: {len(first)} poses, no pair is {delta} frames apart"
        return PoseErrors(status=status, extent=extent)
    scale = 1.0 if fit is None else fit.scale
    motion, rotation = _motions(first, start, start + delta)
    other_motion, other_rotation = _motions(second, start, start + delta)
    translation = np.linalg.norm(scale * other_motion - motion, axis=1)
    angle = _angles_deg(np.swapaxes(rotation, 1, 2) @ other_rotation)
    return _figures(status, translation, angle, extent=extent, fit=fit)


@dataclass(frozen=True)
class PoseAuc:
    """Scale-free agreement of the poses' pairs.

    An error of a pair is the larger of two angles: between the relative rotations, and between the
    directions of the relative translations.
    """

    status: str  # "measured", or "degenerate: ..." with the reason; then the figures are None
    # By threshold in degrees, the area under the share of pairs below the error, in [0, 1].
    auc: dict[float, float | None]
    pairs: int  # how many
    median_rotation_deg: float | None  # median angle between relative rotations
    median_direction_deg: float | None  # median angle between directions of translation
    # Pairs whose reference centres coincide, up to rounding: they have no direction, and count by
    # their rotation alone.
    still: int


def pose_auc(reference: ArrayLike, estimate: ArrayLike) -> PoseAuc:
    """Area under the recall of pairwise pose errors: no alignment, no scale, no unit.

    All pairs of poses count once, at the thresholds AUC_THRESHOLDS. The area is a sum of trapezoids
    over AUC_BINS bins, as GLD's evaluation takes it; poses without any error have 1 - 0.5 /
    AUC_BINS. Where the estimate stands still and the reference does not, the direction is off by 90
    degrees. Poses are as of ``absolute_errors``.
    """
    first, second = _poses(reference, estimate)
    if len(first) < 2:
        reason = f"degenerate: {len(first)} pose(s), at least 2 are needed"
        return PoseAuc(reason, dict.fromkeys(AUC_THRESHOLDS), 0, None, None, 0)
    i, j = np.array(list(combinations(range(len(first)), 2))).T
    motion, rotation = _motions(first, i, j)
    other_motion, other_rotation = _motions(second, i, j)
    turned = _angles_deg(np.swapaxes(rotation, 1, 2) @ other_rotation)
    moves, other_moves = _moves(first, motion), _moves(second, other_motion)
    other_motion = np.where(other_moves[:, None], other_motion, 0.0)
    direction = np.where(moves, _between_deg(motion, other_motion), 0.0)
    error = np.maximum(turned, direction)
    return PoseAuc(
        "measured",
        {threshold: area_under_recall(error, threshold) for threshold in AUC_THRESHOLDS},
        len(error),
        float(np.median(turned)),
        float(np.median(direction[moves])) if moves.any() else None,
        int((~moves).sum()),
    )


def area_under_recall(errors: ArrayLike, threshold: float) -> float:
    """Area under the share of errors below x, for x from 0 to ``threshold``, over the threshold."""
    edges = np.linspace(0, threshold, AUC_BINS + 1)
    values = np.sort(np.asarray(errors, np.float64))
    share = np.searchsorted(values, edges, side="left") / len(values)
    return float(np.trapezoid(share, edges) / threshold)


def _poses(reference: ArrayLike, estimate: ArrayLike) -> tuple[Float64, Float64]:
    first, second = np.asarray(reference, np.float64), np.asarray(estimate, np.float64)
    fit = first.ndim == 3 and first.shape[1:] == (4, 4) and first.shape == second.shape
    if not fit or not (np.isfinite(first) & np.isfinite(second)).all():
        raise ShapeError(
            f"poses: reference {first.shape} and estimate {second.shape}; expected both (N, 4, 4), "
            "without NaN or infinity: leave those frames out and say so"
        )
    for name, poses in (("reference", first), ("estimate", second)):
        rotation = poses[:, :3, :3]
        with np.errstate(over="ignore", invalid="ignore"):
            defect = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max(axis=(1, 2))
            determinant = np.linalg.det(rotation)
        wrong = np.flatnonzero(~(defect <= ROTATION_TOLERANCE) | (determinant < 0))
        if len(wrong):
            raise ShapeError(
                f"poses: the 3x3 part of {name} pose {wrong[0]} is no rotation (R Rᵀ is off I by "
                f"{defect[wrong[0]]:.3g}, determinant {determinant[wrong[0]]:.3g}); divide a scale "
                "out, mend a mirror, or leave the frame out"
            )
    return first, second


def _aligned(
    reference: Float64, estimate: Float64, align: str, *, refuse_mirrored: bool
) -> tuple[str, SimilarityFit | None]:
    if align not in ALIGNMENTS:
        raise OptionError(f"alignment {align!r}; expected one of {', '.join(ALIGNMENTS)}")
    if not len(reference):
        return "degenerate: no poses", None
    if align == "none":
        return UNALIGNED, None
    fit = fit_similarity(estimate[:, :3, 3], reference[:, :3, 3], with_scale=align == "sim3")
    if fit.ok and fit.mirrored and refuse_mirrored:
        return "degenerate: the estimate fits the mirror image of the reference", None
    if "collinear" in fit.status:
        return ON_LINE, fit_line(
            estimate[:, :3, 3], reference[:, :3, 3], with_scale=align == "sim3"
        )
    return (ALIGNED, fit) if fit.ok else (fit.status, None)


def center_extent(poses: Float64) -> float:
    """Twice the largest distance of a centre of (N, 4, 4) world_from_cam from their mean."""
    if not len(poses):
        return 0.0
    centered = poses[:, :3, 3] - poses[0, :3, 3]
    return float(2 * np.linalg.norm(centered - centered.mean(axis=0), axis=1).max())


def _moves(poses: Float64, motion: Float64) -> NDArray[np.bool_]:
    """(P,) whether motions (P, 3) are more than the rounding of the centres."""
    rounding = COINCIDENT * float(np.abs(poses[:, :3, 3]).max())
    return np.linalg.norm(motion, axis=1) > max(STILL * center_extent(poses), rounding)


def _motions(poses: Float64, i: NDArray[np.int64], j: NDArray[np.int64]) -> tuple[Float64, Float64]:
    """Translation (P, 3) and rotation (P, 3, 3) of camera j in camera i's frame."""
    back = np.swapaxes(poses[i, :3, :3], 1, 2)
    step = poses[j, :3, 3] - poses[i, :3, 3]
    return np.einsum("pij,pj->pi", back, step), back @ poses[j, :3, :3]


def _angles_deg(rotations: Float64) -> Float64:
    """(P,) angles of rotations, exact near 0 and near 180 degrees."""
    from scipy.spatial.transform import Rotation

    return np.degrees(np.asarray(Rotation.from_matrix(rotations).magnitude()))


def _between_deg(a: Float64, b: Float64) -> Float64:
    """(P,) angles between vectors; 90 degrees where one of them is 0."""
    cross = np.linalg.norm(np.cross(a, b), axis=1)
    dot = np.einsum("pi,pi->p", a, b)
    angle = np.degrees(np.arctan2(cross, dot))
    return np.where((cross == 0) & (dot == 0), 90.0, angle)


def _figures(
    status: str,
    translation: Float64,
    rotation: Float64,
    *,
    extent: float,
    fit: SimilarityFit | None,
) -> PoseErrors:
    return PoseErrors(
        status=status,
        translation=ErrorStatistics.of(translation),
        translation_share=ErrorStatistics.of(translation / extent) if extent > 0 else None,
        rotation_deg=ErrorStatistics.of(rotation) if len(rotation) else None,
        scale=1.0 if fit is None else fit.scale,
        extent=extent,
        translation_errors=translation,
        rotation_errors_deg=rotation,
    )


Rows = NDArray[np.int64]

# Time stamps of one event, recorded by two clocks, may differ by this, seconds.
MAX_DIFFERENCE = 0.01


def by_time(
    reference: ArrayLike,
    estimate: ArrayLike,
    *,
    max_difference: float = MAX_DIFFERENCE,
    offset: float = 0.0,
) -> tuple[Rows, Rows]:
    """Pairs of nearest time stamps, as evo associates TUM and EuRoC trajectories, in seconds.

    Each pose of the shorter trajectory takes the nearest of the longer one; pairs farther apart
    than the largest difference are none. The offset is added to the estimate's stamps. The rows
    (K,) of both are in the order of the shorter one.
    """
    first, second = np.asarray(reference, np.float64), np.asarray(estimate, np.float64) + offset
    if not (first.size and second.size):
        raise DegenerateError("association by time: a trajectory without poses")
    swapped = len(second) < len(first)
    short, long = (second, first) if swapped else (first, second)
    order = np.argsort(long, kind="stable")
    right = np.clip(np.searchsorted(long[order], short), 1, max(len(long) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(long) - 1)
    nearer = np.abs(long[order[left]] - short) <= np.abs(long[order[right]] - short)
    match = order[np.where(nearer, left, right)]
    gaps = np.abs(long[match] - short)
    # Of those that are nearest to one, the nearest has it.
    nearest = np.lexsort((gaps, match))
    once = nearest[np.unique(match[nearest], return_index=True)[1]]
    kept = np.sort(once[gaps[once] <= max_difference])
    if not len(kept):
        step = float(np.median(np.diff(np.sort(long)))) if len(long) > 1 else 0.0
        near = "or a greater largest difference" if gaps.min() < step / 2 else "if clocks differ"
        spans = " and ".join(
            f"{times.min():.12g} to {times.max():.12g}" for times in (first, second)
        )
        raise DegenerateError(
            f"association by time: no pair within {max_difference:g} s, the nearest are "
            f"{gaps.min():.3g} s apart ({spans} s); give an offset, {near}"
        )
    return (match[kept], kept) if swapped else (kept, match[kept])


def by_name(reference: Sequence[str], estimate: Sequence[str]) -> tuple[Rows, Rows]:
    """Rows of equal names, in the reference's order; see ``gvtools.scenes.matching.paired``."""
    for names in (reference, estimate):
        if len(set(names)) < len(names):
            twice = next(name for name, count in Counter(names).items() if count > 1)
            raise DegenerateError(f"association by name: {twice!r} occurs twice in one trajectory")
    rows = np.array(paired(reference, estimate), np.int64).reshape(-1, 2)
    if not len(rows):
        raise DegenerateError(
            f"association by name: none of {len(reference)} and {len(estimate)} names is equal "
            f"(such as {next(iter(reference), '')!r} and {next(iter(estimate), '')!r})"
        )
    return rows[:, 0], rows[:, 1]


def by_index(reference: int, estimate: int) -> tuple[Rows, Rows]:
    """Row by row, of as many poses in both."""
    if reference != estimate or not reference:
        raise DegenerateError(
            f"association by index: {reference} and {estimate} poses; expected as many"
        )
    rows = np.arange(reference)
    return rows, rows


# Fewer poses tell nothing; so many that are exactly one were held.
FEW, HELD = 8, 3
# A reading explains an error where it leaves less than this share of it; errors are worth it from
# this share of the path's extent, and from so many degrees.
EXPLAINED, NOTABLE, TURNED = 0.2, 0.002, 10.0
# Places by which an estimate may be late or early, rows of each path that are compared then, and
# rows at which a clock may jump.
PLACES, ROWS, JUMPS = 60, 500, 60
# Where the path's spread across itself is less than so many errors, the turn of the fit is open.
ACROSS = 10.0


def wrong_conventions(
    reference: ArrayLike, estimate: ArrayLike, *, align: str = "sim3"
) -> tuple[str, ...]:
    """A line for each convention of which another reading would take most of the error away.

    Tried are camera from world, another unit, other places in time, the other order of quaternions
    and other axes of the cameras; and poses that stay exactly one while the reference moves are
    counted.

    Args:
        reference: (N, 4, 4) world_from_cam, scene units.
        estimate: (N, 4, 4), row by row the same cameras.
        align: as of ``absolute_errors``.

    >>> poses = np.tile(np.eye(4), (8, 1, 1))
    >>> poses[:, :3, 3] = np.random.default_rng(0).standard_normal((8, 3))
    >>> wrong_conventions(poses, poses @ np.diag([1, -1, -1, 1]))[0][:52]
    "the estimate's cameras are turned by 180 degrees abo"
    """
    first, second = np.asarray(reference, np.float64), np.asarray(estimate, np.float64)

    def errors(poses: Float64, how: str = align) -> PoseErrors:
        return absolute_errors(first, poses, align=how, refuse_mirrored=False)

    found = errors(second)
    if found.translation is None or found.rotation_deg is None or len(first) < FEW:
        return ()
    notes, left = [], found.translation.rmse
    if left > NOTABLE * found.extent:
        inverted, scaled = errors(invert_rigid(second)).translation, errors(second, "sim3")
        if inverted is not None and inverted.rmse < EXPLAINED * left:
            notes.append(
                "one of both seems to hold camera from world: with the estimate inverted, ATE "
                f"would be {inverted.rmse:.4g} instead of {left:.4g}; expected world from camera"
            )
        elif align == "se3" and scaled.translation and scaled.translation.rmse < EXPLAINED * left:
            notes.append(
                f"another unit: with the estimate times {scaled.scale:.4g}, ATE would be "
                f"{scaled.translation.rmse:.4g} instead of {left:.4g} (--align sim3)"
            )
        elif (moved := _moved_in_time(first, second, align=align))[0] < EXPLAINED * left:
            side = "later" if moved[1] > 0 else "earlier"
            notes.append(
                f"the estimate's poses seem to belong {abs(moved[1])} places {side}: ATE would be "
                f"{moved[0]:.4g} instead of {left:.4g}; clocks that differ (--offset), or frames "
                "that are numbered otherwise"
            )
        elif (jump := _clock_jump(first, second, align=align))[0] < EXPLAINED * left:
            notes.append(
                f"a clock seems to jump near pose {jump[1]} of {len(first)}: the estimate's poses "
                f"belong {jump[2]:+d} places before it and {jump[3]:+d} after; ATE would be "
                f"{jump[0]:.4g} instead of {left:.4g}; correct the time stamps of one part"
            )
    centers = first[:, :3, 3] - first[:, :3, 3].mean(axis=0)
    across = np.linalg.svd(centers, compute_uv=False)[1] / np.sqrt(len(first))
    if found.rotation_deg.rmse > TURNED and left * ACROSS < across:
        notes += _other_turn(first, second, found, align=align)
    _, which, counts = np.unique(
        second.reshape(-1, 16), axis=0, return_inverse=True, return_counts=True
    )
    held = np.flatnonzero(which.reshape(-1) == counts.argmax())
    if len(held) >= HELD and center_extent(first[held]) > NOTABLE * found.extent:
        notes.append(
            f"{len(held)} poses of the estimate are exactly one, though the reference moves: "
            "leave poses out where tracking was lost"
        )
    return tuple(notes)


def _moved_in_time(first: Float64, second: Float64, *, align: str) -> tuple[float, int]:
    """The least ATE of an estimate some places later, or 0 (earlier: below), and how many."""
    still = absolute_errors(first, second, align=align, refuse_mirrored=False).translation
    tried = [(np.inf if still is None else still.rmse, 0)]
    for places in range(1, min(PLACES, len(first) // 3) + 1):
        every = max(1, (len(first) - places) // ROWS)
        for sign, late, early in ((1, first, second), (-1, second, first)):
            pair = late[places::every], early[:-places:every]
            found = absolute_errors(*pair[::sign], align=align, refuse_mirrored=False)
            if found.translation is not None:
                tried.append((found.translation.rmse, sign * places))
    return min(tried)


def _clock_jump(first: Float64, second: Float64, *, align: str) -> tuple[float, int, int, int]:
    """The least ATE with other places from some row on; the row, the places before and after."""
    count, part = len(first), len(first) // 4
    ends = slice(0, part), slice(count - part, count)
    before, after = (_moved_in_time(first[e], second[e], align=align)[1] for e in ends)
    tried = [(np.inf, 0, before, after)]
    for row in (
        np.linspace(part, count - part, JUMPS).astype(int).tolist() if before != after else []
    ):
        own = np.arange(count)
        other = own + np.where(own < row, before, after)
        # Beside the jump there are poses that the other path lacks.
        kept = (np.abs(own - row) > abs(after - before)) & (other >= 0) & (other < count)
        found = absolute_errors(
            first[other[kept]], second[own[kept]], align=align, refuse_mirrored=False
        )
        if found.translation is not None:
            tried.append((found.translation.rmse, row, before, after))
    return min(tried)


def _other_turn(first: Float64, second: Float64, found: PoseErrors, *, align: str) -> list[str]:
    """Lines for rotations that do not agree where the centres do."""
    from scipy.spatial.transform import Rotation

    assert found.rotation_deg is not None
    turned = found.rotation_deg.rmse

    def left(rotations: Rotation, true: Rotation) -> float:
        poses = [first.copy(), second.copy()]
        for each, turns in zip(poses, (true, rotations), strict=True):
            each[:, :3, :3] = turns.as_matrix()
        again = absolute_errors(*poses, align=align, refuse_mirrored=False)
        return np.inf if again.rotation_deg is None else again.rotation_deg.rmse

    true, given = (Rotation.from_matrix(poses[:, :3, :3]) for poses in (first, second))
    fit = fit_similarity(second[:, :3, 3], first[:, :3, 3], with_scale=align == "sim3")
    frame = Rotation.identity() if align == "none" else Rotation.from_matrix(fit.rotation)
    mount = (true.inv() * frame * given).mean()
    if left(given * mount.inv(), true) < EXPLAINED * turned:
        axis = (np.round(mount.as_rotvec() / mount.magnitude(), 2) + 0.0).tolist()
        return [
            f"the estimate's cameras are turned by {np.degrees(mount.magnitude()):.4g} degrees "
            f"about their axis {axis} all along: other axes of the camera (OpenGL's), or another "
            "sensor's poses; figures of rotation, RPE and AUC hold this turn"
        ]
    inverted = min(left(given.inv(), true), left(given, true.inv()))
    if inverted < EXPLAINED * turned:
        return [
            "one file's rotations seem to map the other way (from world to camera, beside centres "
            f"in the world): inverted, they are off by {inverted:.4g} degrees, not {turned:.4g}"
        ]
    estimates, references = (
        [Rotation.from_quat(turns.as_quat()[:, order]) for order in ([1, 2, 3, 0], [3, 0, 1, 2])]
        for turns in (given, true)
    )
    ways = {
        "the estimate's": min(left(other, true) for other in estimates),
        "the reference's": min(left(given, other) for other in references),
        "both files'": min(starmap(left, product(estimates, references))),
    }
    whose, least = min(ways.items(), key=lambda way: way[1])
    if least >= EXPLAINED * turned:
        return []
    # In one frame, the order of either explains the same.
    if max(ways["the estimate's"], ways["the reference's"]) < EXPLAINED * turned:
        whose = "one file's"
    return [
        f"{whose} quaternions seem to be of the other order: with the real part at the other end, "
        f"rotations are off by {least:.4g} degrees instead of {turned:.4g}; name the "
        "columns in a first line ('# timestamp tx ty tz qw qx qy qz')"
    ]
