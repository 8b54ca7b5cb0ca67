"""Inspection of a scene: what a run would read of it, and what is wrong with it."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from gvtools.errors import GvError
from gvtools.scenes.pose_contradictions import GreyThumbnail, contradiction_findings, thumbnail
from gvtools.scenes.scene import Finding, Scene

# Focal lengths of usual lenses, over the image's sides.
FOCAL = (0.1, 50.0)
# Mean reprojection error, pixels, above which a model is no good one.
REPROJECTION = 4.0


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

    Files that cannot be read become error findings; nothing is raised for them.

    Args:
        probes: how many views have their pixels decoded, evenly spread; None: all.
    """
    findings = list(scene.findings)
    opened = _open(scene, spread(len(scene), probes), findings)
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
    findings += _doubtful_cameras(scene, errors)
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
        findings=tuple(findings),
    )


def reprojection_errors(scene: Scene) -> np.ndarray:
    """(M,) float64, pixels: for each track element, projection minus detection, in length.

    NaN where the point lies behind the camera.
    """
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


def _open(scene: Scene, numbers: list[int], findings: list[Finding]) -> list[_Opened]:
    known = {finding.message for finding in findings}
    opened, empty = [], []
    for number in numbers:
        view = scene.views[number]
        try:
            frame = view.load()
        except GvError as error:
            if str(error) not in known:
                findings.append(Finding("error", str(error)))
            continue
        masked = 0.0 if frame.mask is None else 1.0 - float(frame.mask.mean())
        seen = number, thumbnail(frame), masked
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
    if empty:
        message = f"{len(empty)} depth maps hold no valid pixel, first {empty[0]}"
        findings.append(Finding("warning", message))
    return opened


def _views_without_depth(scene: Scene) -> list[Finding]:
    without = sum(not view.has_depth for view in scene.views)
    if not without:
        return []
    if len(scene) < 2:
        message = "the only view has no depth, and depth cannot be computed from one photograph"
        return [Finding("warning", message)]
    if without == len(scene):
        which, whose = f"none of the {len(scene)} views has recorded depth", "it"
    else:
        which = f"recorded depth in {len(scene) - without} of the {len(scene)} views"
        whose = "that of the others"
    message = f"{which}; a run computes {whose} from the photographs (plane-sweep stereo)"
    return [Finding("info", message)]


def _doubtful_cameras(scene: Scene, errors: np.ndarray) -> list[Finding]:
    """Intrinsics that no camera has, and poses that the sparse points contradict."""
    findings = []
    odd = []
    for view in scene.views:
        K = view.camera.K[0]
        size = np.array([view.camera.width[0], view.camera.height[0]])
        focal = np.array([K[0, 0], K[1, 1]]) / size
        center = K[:2, 2] / size
        if focal.min() < FOCAL[0] or focal.max() > FOCAL[1] or np.abs(center - 0.5).max() > 0.5:
            odd.append(view.name)
    if odd:
        message = (
            f"{len(odd)} views have intrinsics that no camera has (focal length outside "
            f"{FOCAL[0]} to {FOCAL[1]:g} image sides, or a principal point outside the image): "
            f"first {odd[0]}"
        )
        findings.append(Finding("warning", message))
    known = errors[np.isfinite(errors)]
    mean = float(known.mean()) if known.size else 0.0
    if mean > REPROJECTION:
        message = (
            f"the sparse points miss their detections by {mean:.3g} pixels on average; expected "
            f"below {REPROJECTION:g}: poses or intrinsics are wrong"
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
    return DepthSummary(
        views,
        sum(item.valid for item in opened) / pixels,
        float(ranges[:, 0].min()),
        float(np.median(ranges[:, 1])),
        float(ranges[:, 2].max()),
    )
