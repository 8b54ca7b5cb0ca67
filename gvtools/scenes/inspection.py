"""Inspection of a scene: what a run would read of it, and what is wrong with it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from math import hypot
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import GvError
from gvtools.scenes.depth_contradictions import depth_findings
from gvtools.scenes.matching import named
from gvtools.scenes.pixel_contradictions import PixelCheck
from gvtools.scenes.pose_forms import pose_findings
from gvtools.scenes.scene import Finding, Frame, Scene, counted

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# Focal lengths of usual lenses, over the image's sides.
FOCAL = (0.1, 50.0)
# Pictures whose grey levels deviate less than this show nothing.
BLANK = 0.5
# A view's mean reprojection error, pixels, above which its camera is wrong, of so many detections;
# from half of it on where others, of the lower quarter, have so many times less.
REPROJECTION, DETECTIONS, TIMES_USUAL = 4.0, 10, 3.0


@dataclass(frozen=True)
class DepthSummary:
    """Depth of the views that were opened."""

    views: int  # of the scene's views, how many have a depth map
    coverage: float | None  # share of valid pixels over the opened views with depth
    minimum: float | None  # scene units
    median: float | None  # scene units; the middle of the views' own medians
    maximum: float | None  # scene units


@dataclass(frozen=True)
class SceneReport:
    """What ``gvtools check`` prints."""

    root: str  # the project's folder
    kind: str  # "colmap", "rgbd" or "transforms"
    ok: bool  # a run can read it: at least one view, and no error among the findings
    views: int  # how many
    dropped: int  # frames that were left out, for reasons among the findings
    views_opened: int  # how many had their pixels decoded
    sizes: dict[str, int]  # "WIDTHxHEIGHT" with the number of views of that size
    focal_px: tuple[float, float]  # smallest and largest focal length of the views' pinhole cameras
    depth: DepthSummary | None  # None when no view has depth
    masked: float  # share of pixels that masks take out, over the opened views
    sparse_points: int  # how many
    observations: int  # their track elements
    # mean distance between detection and projection in the views' cameras
    reprojection_px: float | None
    metric: bool  # scene units are metres
    path_length: float  # from camera to camera in order, scene units
    extent: float  # largest side of the box around the camera centres, scene units
    findings: tuple[Finding, ...]  # the reader's and this report's own

    def to_dict(self) -> dict[str, Any]:
        """The report as JSON-ready values; a figure that is not known is None."""
        return asdict(self)


class _Opened(NamedTuple):
    """One view that was decoded: its number, its masked share, and of its depth what is valid."""

    view: int
    thumbnail: GreyThumbnail
    masked: float
    pixels: int = 0
    valid: int = 0
    range: tuple[float, float, float] = (0.0, 0.0, 0.0)


def inspect(scene: Scene, *, probes: int | None = None) -> SceneReport:
    """Open a scene's files and sum up what a run would get.

    Files that cannot be read become error findings; nothing is raised for them. At most ``probes``
    views, evenly spread, have their pixels decoded.
    """
    findings = list(scene.findings)
    pixels = PixelCheck(scene)
    opened = _open(scene, spread(len(scene), probes), findings, pixels=pixels)
    cameras = scene.cameras if scene.views else None
    focal = cameras.K[:, (0, 1), (0, 1)] if cameras is not None else np.zeros((1, 2))
    centers = cameras.centers if cameras is not None else np.zeros((1, 3))
    sizes = Counter(
        f"{int(view.camera.width[0])}x{int(view.camera.height[0])}" for view in scene.views
    )
    if not scene.views:
        findings.append(Finding("error", "no view; expected at least one"))
    if len(scene.views) > 1 and not np.ptp(centers, axis=0).any():
        findings.append(Finding("warning", "all cameras stand at the same place: no parallax"))
    errors = reprojection_errors(scene)
    findings += _views_without_depth(scene)
    findings += camera_findings(scene, errors)
    findings += pixels.findings()
    findings += pose_findings(scene)
    findings += depth_findings(scene)
    findings += contradiction_findings(
        scene,
        {item.view: item.thumbnail for item in opened},
        {item.view: item.range[1] for item in opened if item.valid},
    )
    return SceneReport(
        root=str(scene.root),
        kind=scene.kind,
        ok=bool(scene.views) and all(finding.level != "error" for finding in findings),
        views=len(scene),
        dropped=sum(finding.dropped for finding in findings),
        views_opened=len(opened),
        sizes=dict(sizes),
        focal_px=(float(focal.min()), float(focal.max())),
        depth=_depth(scene, opened),
        masked=float(np.mean([item.masked for item in opened])) if opened else 0.0,
        sparse_points=0 if scene.points is None else len(scene.points.positions),
        observations=0 if scene.points is None else len(scene.points.point_index),
        reprojection_px=float(np.nanmean(errors)) if np.isfinite(errors).any() else None,
        metric=scene.metric,
        path_length=float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum()),
        extent=float(np.ptp(centers, axis=0).max()),
        findings=tuple(_of_kinds(findings)),
    )


def _of_kinds(findings: Sequence[Finding]) -> list[Finding]:
    """The findings, those that say the same of several files as one."""
    kinds = dict[tuple[str, str], list[Finding]]()
    for finding in findings:
        file, _, text = finding.message.partition(": ")
        same = text if "/" in file and text else finding.message
        kinds.setdefault((finding.level, same), []).append(finding)
    merged = []
    for (level, text), alike in kinds.items():
        files = [each.message.partition(": ")[0] for each in alike]
        line = f"{len(files)} files ({named(files)}): {text}"
        dropped = sum(each.dropped for each in alike)
        merged.append(alike[0] if len({*files}) == 1 else Finding(level, line, dropped))
    return merged


def reprojection_errors(scene: Scene) -> np.ndarray:
    """(M,) pixels between projection and detection of each track element; NaN behind a camera."""
    points = scene.points
    if points is None or not len(points.point_index):
        return np.zeros(0)
    cameras = scene.cameras
    errors = np.full(len(points.point_index), np.nan)
    for view, rows in enumerate(points.rows_of_views(len(scene))):
        xy, _ = cameras[view].project(points.positions[points.point_index[rows]])
        errors[rows] = np.linalg.norm(xy[0] - points.xy[rows], axis=1)
    return errors


def spread(count: int, probes: int | None) -> list[int]:
    """At most so many of ``count`` numbers, evenly spread, the first and the last among them.

    >>> spread(10, 4), spread(2, 4), spread(2, None)
    ([0, 3, 6, 9], [0, 1], [0, 1])
    """
    if probes is None or probes >= count:
        return list(range(count))
    return np.linspace(0, count - 1, probes).round().astype(int).tolist()


def _open(
    scene: Scene, numbers: list[int], findings: list[Finding], *, pixels: PixelCheck
) -> list[_Opened]:
    known = {finding.message.partition(": ")[0] for finding in findings}  # files
    opened, empty, blank = [], [], []
    for number in numbers:
        view = scene.views[number]
        try:
            frame = view.load()
        except GvError as error:
            if str(error).partition(": ")[0] not in known:
                findings.append(Finding("error", str(error)))
            continue
        pixels.see(number, frame.rgb)
        masked = 0.0 if frame.mask is None else 1.0 - float(frame.mask.mean())
        seen = number, thumbnail(frame), masked
        if seen[1].grey.std() < BLANK:
            blank.append(view.name)
        if frame.depth is None:
            opened.append(_Opened(*seen))
            continue
        valid = frame.depth[frame.depth > 0]
        if valid.size:
            spread = float(valid.min()), float(np.median(valid)), float(valid.max())
            opened.append(_Opened(*seen, frame.depth.size, valid.size, spread))
        else:
            opened.append(_Opened(*seen, frame.depth.size))
            empty.append(view.name)
    for names, line in (
        (blank, f"of {len(numbers)} pictures show one colour alone"),
        (empty, "depth maps hold no valid pixel"),
    ):
        findings += counted(len(names), f"{line}, first {names[0] if names else ''}")
    return opened


def _views_without_depth(scene: Scene) -> list[Finding]:
    without = sum(not view.has_depth for view in scene.views)
    if not without:
        return []
    if len(scene) < 2:
        message = "the only view has no depth, and depth cannot be computed from one photograph"
        return [Finding("warning", message)]
    line = f"none of the {without} views has recorded depth; a run computes it"
    if without < len(scene):
        line = (
            f"recorded depth in {len(scene) - without} of the {len(scene)} views; a run computes "
        )
        line += "that of the others"
    return [Finding("info", f"{line} from the photographs (plane-sweep stereo)")]


def camera_findings(scene: Scene, errors: np.ndarray) -> list[Finding]:
    """Intrinsics that no camera has, and poses that the sparse points contradict."""
    findings = []
    K = np.array([view.camera.K[0] for view in scene.views]).reshape(-1, 3, 3)
    size = np.array([[*view.camera.width, *view.camera.height] for view in scene.views])
    sides = K[:, :2] / size.reshape(-1, 2, 1)
    focal, center = sides[:, (0, 1), (0, 1)], np.abs(sides[:, :, 2] - 0.5).max(axis=1)
    strange = (focal.min(axis=1) < FOCAL[0]) | (focal.max(axis=1) > FOCAL[1]) | (center > 0.5)
    if odd := [view.name for view, wrong in zip(scene.views, strange, strict=True) if wrong]:
        message = (
            f"{len(odd)} views have intrinsics that no camera has (focal length outside "
            f"{FOCAL[0]} to {FOCAL[1]:g} image sides, or a principal point outside the image): "
            f"first {odd[0]}"
        )
        findings.append(Finding("warning", message))
    points = scene.points
    rows = [] if points is None else points.rows_of_views(len(scene))
    told = [n for n, own in enumerate(rows) if np.isfinite(errors[own]).sum() >= DETECTIONS]
    means = np.array([np.nanmean(errors[rows[n]]) for n in told])
    usual = float(np.quantile(means, 0.25)) if told else 0.0
    high = means > min(REPROJECTION, max(REPROJECTION / 2, TIMES_USUAL * usual))
    if high.any():
        names = named([scene.views[n].name for n in np.array(told)[high]])
        message = (
            f"the sparse points miss their detections by {means[high].mean():.3g} pixels on "
            f"average in {high.sum()} of {len(told)} views ({names}); expected below "
            f"{REPROJECTION:g}, and as in the others: poses or intrinsics of these are wrong"
        )
        findings.append(Finding("warning", message))
    return findings


def _depth(scene: Scene, opened: list[_Opened]) -> DepthSummary | None:
    views = sum(view.has_depth for view in scene.views)
    if not views:
        return None
    pixels = sum(item.pixels for item in opened)
    ranges = np.array([item.range for item in opened if item.valid]).reshape(-1, 3)
    if not len(ranges):
        return DepthSummary(views, 0.0 if pixels else None, None, None, None)
    low, median, high = ranges[:, 0].min(), np.median(ranges[:, 1]), ranges[:, 2].max()
    coverage = sum(item.valid for item in opened) / pixels
    return DepthSummary(views, coverage, float(low), float(median), float(high))


# --- poses that contradict each other -------------------------------------------------------------
#
# Structure from motion can give pictures of one side of an object that repeats the poses of the
# other; every point fits. Nearly equal cameras that see different surroundings tell: the homography
# ``K_b R K_a⁻¹`` carries one small picture onto the other up to a few pixels. Windows are compared
# by zero-normalised cross-correlation at the best of a few shifts.

# Cameras count as nearly equal below this distance, in scene depths, and this angle.
NEAR = 0.06
NEAR_DEGREES = 10.0
# How many of its nearest cameras a view is compared with.
NEIGHBORS = 6
# Pictures are compared at this length of the longer side, in square windows, at shifts, in pixels.
SIDE, WINDOW, SHIFT = 48, 9, 3
# A window has contrast from this standard deviation, grey levels, and agrees from this correlation.
CONTRAST, AGREE = 4.0, 0.5
# Rows of one are as bright as those of the other, up to these factors.
GAINS = (0.6, 1.7)
# Pictures can be compared when this share of them has contrast, and contradict each other when more
# than the second share of that disagrees. On six real scenes it is at most 0.03, in 120 views
# around an object 0.15.
COMPARABLE, DISAGREEING = 0.3, 0.2
# Nor can they where parallax moves more than this share of the sparse points farther than the
# shifts: in a forward walk past near things, or with a long lens.
BEYOND = 0.03
# Sparse points contradict when each view has at least this many that lie in the other's picture,
# and less than this share of them is of both. On three real scenes it is at least 0.5.
POINTS, SHARED = 30, 0.05
# Places of the shifted window in the padded picture, unshifted first.
_SHIFTS = sorted(
    product(range(2 * SHIFT + 1), repeat=2), key=lambda at: hypot(at[0] - SHIFT, at[1] - SHIFT)
)


class GreyThumbnail(NamedTuple):
    """A picture reduced for comparison: (h, w) float32 grey levels, and where they may be used."""

    grey: Float32
    valid: NDArray[np.bool_]


@dataclass(frozen=True)
class Contradiction:
    """Two views whose poses cannot both be right."""

    names: tuple[str, str]  # of the two
    worse: float  # the share of the picture that differs; 1 where no points are shared
    evidence: str

    def __str__(self) -> str:
        return f"{self.names[0]} and {self.names[1]} ({self.evidence})"


def _shared(
    scene: Scene, own: Sequence[NDArray[np.int32]], views: tuple[int, int]
) -> tuple[int, int] | None:
    """How many of the ``own`` points two views share, of how many; None where too few can tell."""
    assert scene.points is not None
    inside = []
    for view, other in zip(views, reversed(views), strict=True):
        camera, positions = scene.views[other].camera, scene.points.positions[own[view]]
        (xy,), (z,) = camera.project(positions)
        with np.errstate(invalid="ignore"):
            seen = (z > 0) & (xy >= 0).all(-1) & (xy < [*camera.width, *camera.height]).all(-1)
        inside.append(int(seen.sum()))
    if min(inside) < POINTS:
        return None
    return len(np.intersect1d(own[views[0]], own[views[1]])), min(inside)


def _beyond(cameras: Cameras, points: Float64, views: tuple[int, int]) -> float:
    """Share of points, world (N, 3), that parallax moves beyond the shifts."""
    rotation = cameras.cam_from_world[views[1], :3, :3]
    side = SIDE / max(cameras.width[views[1]], cameras.height[views[1]])
    local = np.array([(points - cameras.centers[view]) @ rotation.T for view in views])
    seen = local[:, (local[:, :, 2] > 0).all(axis=0)]
    first, second = seen[..., :2] / seen[..., 2:] * cameras.K[views[1], 0, 0] * side
    return float((np.abs(first - second).max(axis=1) > SHIFT).mean()) if len(first) else 0.0


def turn_degrees(a: Float64, b: Float64) -> Float64:
    """(...) degrees between rotations, which (..., 3, 3) or (..., 4, 4) begin with."""
    apart = np.linalg.norm(a[..., :3, :3] - b[..., :3, :3], axis=(-2, -1))
    # The Frobenius distance of two rotations that differ by the angle t is sqrt(8) sin(t / 2).
    return np.asarray(np.degrees(2 * np.arcsin(np.minimum(apart / np.sqrt(8), 1))))


def thumbnail(frame: Frame) -> GreyThumbnail:
    """The frame's picture reduced to ``SIDE`` pixels on its longer side."""
    height, width = frame.rgb.shape[:2]
    scale = SIDE / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    grey = cv2.resize(
        cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA
    )
    valid = np.ones(grey.shape, np.bool_)
    if frame.mask is not None:
        share = cv2.resize(frame.mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        valid = share > 0.99
    return GreyThumbnail(grey.astype(np.float32), valid)


def contradiction_findings(
    scene: Scene, thumbnails: Mapping[int, GreyThumbnail], depths: Mapping[int, float]
) -> list[Finding]:
    """One warning when nearly equal cameras see different things; ``depths`` are medians."""
    found = contradictions(scene, thumbnails, depths)
    if not found:
        return []
    message = (
        f"{len(found)} pairs of views have nearly equal cameras but show different things: "
        f"{named(found)}; expected at most "
        f"{DISAGREEING:.0%} of the picture to differ and at least {SHARED:.0%} of the points to be "
        "shared: their poses contradict each other (an object that looks alike from two sides, "
        "swapped pictures), or something large moved, or light flickers in bands; look at these "
        "pairs, then solve the poses again or leave the wrong views out (--context)"
    )
    return [Finding("warning", message)]


def contradictions(
    scene: Scene, thumbnails: Mapping[int, GreyThumbnail], depths: Mapping[int, float]
) -> list[Contradiction]:
    """The pairs of views whose poses contradict each other, worst first; arguments as above."""
    if len(scene) < 2:
        return []
    cameras, points = scene.cameras, scene.points
    rows = [] if points is None else points.rows_of_views(len(scene))
    own = [np.unique(points.point_index[each]) for each in rows] if points is not None else []
    found = []
    for a, b in _near_pairs(cameras, _reach(scene, depths, own)):
        shared = None if points is None else _shared(scene, own, (a, b))
        unshared = shared is not None and shared[0] < SHARED * shared[1]
        differs = 0.0
        near = points is None or _beyond(cameras, points.positions[own[a]], (a, b)) <= BEYOND
        if near and a in thumbnails and b in thumbnails:
            pair = thumbnails[a], thumbnails[b]
            enough = 0.0 if unshared else DISAGREEING
            H = homography(pair, cameras, (a, b))
            differs = disagreement(*pair, H, enough=enough) or 0.0
        names = scene.views[a].name, scene.views[b].name
        if differs > DISAGREEING:
            found.append(Contradiction(names, differs, f"{differs:.0%} of the picture differs"))
        elif unshared and shared is not None:
            line = f"{shared[0]} of {shared[1]} sparse points shared"
            found.append(Contradiction(names, 1.0, line))
    return sorted(found, key=lambda pair: -pair.worse)


def disagreement(
    a: GreyThumbnail, b: GreyThumbnail, H: Float64, *, enough: float = 0.0
) -> float | None:
    """Share of what has contrast in both pictures that differs; None where that is too little.

    The search among shifts, which lower it alone, ends once it is at most ``enough``.
    """
    x = a.grey
    size, flags = a.grey.shape[::-1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    y, there = (
        np.asarray(cv2.warpPerspective(each.astype(np.float32), H, size, flags=flags), np.float32)
        for each in (b.grey, b.valid)
    )
    mask = ((there > 0.99) & a.valid).astype(np.float32)
    # A lamp that flickers lights other rows in each picture, or columns of turned ones.
    for axis in (0, 1):
        light = [(mask * picture).sum(axis, keepdims=True) for picture in (x, y)]
        y = y * np.clip(light[0] / np.maximum(light[1], 1), *GAINS)
    weight = np.maximum(_window(mask), 1e-6)
    mean_y = _window(mask * y) / weight
    var_y = np.maximum(_window(mask * y * y) / weight - mean_y**2, 0)
    best = np.full(x.shape, -1.0, np.float32)
    contrast = np.zeros(x.shape, np.bool_)
    share = 1.0
    padded = cv2.copyMakeBorder(x, *(SHIFT,) * 4, cv2.BORDER_REPLICATE)
    for dy, dx in _SHIFTS:
        moved = padded[dy : dy + x.shape[0], dx : dx + x.shape[1]]
        weighted = mask * moved
        mean_x = _window(weighted) / weight
        var_x = np.maximum(_window(weighted * moved) / weight - mean_x**2, 0)
        both = _window(weighted * y) / weight
        correlation = (both - mean_x * mean_y) / np.sqrt(var_x * var_y + 1e-3)
        np.maximum(best, correlation, out=best)
        if dx == dy == SHIFT:
            contrast = (np.minimum(var_x, var_y) > CONTRAST**2) & (weight > 0.4)
            if contrast.mean() < COMPARABLE:
                return None
        share = float((best[contrast] < AGREE).mean())
        if share <= enough:
            break
    return share


def _window(values: Float32) -> Float32:
    """Means over windows; what lies outside the picture counts as zero."""
    return np.asarray(cv2.blur(values, (WINDOW, WINDOW), borderType=cv2.BORDER_CONSTANT))


def homography(
    pair: tuple[GreyThumbnail, GreyThumbnail], cameras: Cameras, views: tuple[int, int]
) -> Float64:
    """(3, 3) from pixels of the first picture to those of the second, as OpenCV counts them."""
    Ks = []
    for picture, view in zip(pair, views, strict=True):
        height, width = picture.grey.shape
        scale = np.array([width / cameras.width[view], height / cameras.height[view], 1])
        Ks.append(scale[:, None] * cameras.K[view])
    poses = cameras.cam_from_world
    rotation = poses[views[1], :3, :3] @ poses[views[0], :3, :3].T
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])  # OpenCV counts from pixel centres
    return np.asarray(np.linalg.inv(half) @ Ks[1] @ rotation @ np.linalg.inv(Ks[0]) @ half)


def _reach(scene: Scene, depths: Mapping[int, float], own: Sequence[NDArray[np.int32]]) -> Float64:
    """(V,) how far another camera may stand from each, by depth or what stands for it."""
    cameras, known = scene.cameras, dict(depths)
    for view, (rows, axis) in enumerate(zip(own, cameras.cam_from_world[:, 2], strict=False)):
        if len(rows) and scene.points is not None:
            known[view] = float(np.median(scene.points.positions[rows] @ axis[:3] + axis[3]))
    if known:
        middle = float(np.median(list(known.values())))
        return NEAR * np.array([known.get(view, middle) for view in range(len(scene))])
    # As deep as the cameras are spread; half the mean step from view to view is the most.
    step = float(np.linalg.norm(np.diff(cameras.centers, axis=0), axis=1).mean())
    return np.full(len(scene), min(NEAR * float(np.ptp(cameras.centers, axis=0).max()), step / 2))


def _near_pairs(cameras: Cameras, reach: Float64) -> list[tuple[int, int]]:
    """Numbers of cameras that are nearly equal."""
    from scipy.spatial import KDTree

    centers, rotations = cameras.centers, cameras.cam_from_world[:, :3, :3]
    unit = float(np.median(reach))
    if not unit > 0:
        return []
    # The Frobenius distance of two rotations that differ by the angle t is sqrt(8) sin(t / 2).
    turn = np.sqrt(8) * np.sin(np.radians(NEAR_DEGREES) / 2)
    places = np.concatenate([centers / unit, rotations.reshape(-1, 9) / turn], axis=1)
    count = min(NEIGHBORS + 1, len(cameras))
    _, nearest = KDTree(places).query(places, count)
    pairs = {(min(a, int(b)), max(a, int(b))) for a, row in enumerate(nearest) for b in row}
    return [
        (a, b)
        for a, b in sorted(pairs)
        if a != b
        and np.linalg.norm(centers[a] - centers[b]) < min(reach[a], reach[b])
        and turn_degrees(rotations[a], rotations[b]) < NEAR_DEGREES
    ]
