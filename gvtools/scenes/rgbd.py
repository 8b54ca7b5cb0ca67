"""Posed RGB-D folders: what their layouts have in common.

A layout is one file that defines an ``RgbdLayout``, and a line in ``project.LAYOUTS``. Its
``record`` finds frames, poses and intrinsics and describes them as a ``Recording``; here they
become a scene. Every supported layout publishes intrinsics whose first pixel centre is (0, 0), as
Kinect drivers and Open3D count; they are moved by half a pixel to the project's (0.5, 0.5) in this
file, once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gvtools.cameras import invert_rigid, rigid_transform
from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.images import read_depth, read_header
from gvtools.scenes.photographs import (
    Photograph,
    Registration,
    depth_findings,
    header_findings,
    lens_findings,
    rotation_findings,
)
from gvtools.scenes.rgbd_recording import Float64, Recording, RgbdFrame, RgbdOptions
from gvtools.scenes.scene import Finding, Scene, natural_key
from gvtools.scenes.undistort import undistortion
from gvtools.settings import changes, with_file

SIDECAR = "rgbd.json"


@dataclass(frozen=True)
class RgbdLayout:
    """A way to lay out a posed RGB-D recording in a folder.

    Attributes:
        looks_like: its name and what its folder holds, for messages.
        matches: whether a folder is of this layout.
        record: finds frames, poses and intrinsics in a folder, with the options that were given.
    """

    looks_like: str
    matches: Callable[[Path], bool]
    record: Callable[[Path, RgbdOptions], Recording]

    def read(self, root: Path, *, options: RgbdOptions | None = None) -> Scene:
        """The folder ``root`` as a scene, metric, in the poses' own world frame.

        Args:
            root: the folder.
            options: what the folder does not tell by itself.
        """
        root = Path(root)
        resolved, findings = resolve_options(root, options)
        recording = self.record(root, resolved)
        return rgbd_scene(replace(recording, findings=[*findings, *recording.findings]), resolved)


def resolve_options(root: Path, options: RgbdOptions | None) -> tuple[RgbdOptions, list[Finding]]:
    """``options`` over those of the folder's ``rgbd.json``, and a finding when that was read."""
    options = options or RgbdOptions()
    path = root / SIDECAR
    if not path.is_file():
        return options, []
    read = with_file(RgbdOptions(), path)
    merged = read.replaced(**{name: getattr(options, name) for name in options.model_fields_set})
    names = ", ".join(sorted(changes(RgbdOptions(), read)))
    return merged, [Finding("info", f"options read from {SIDECAR}: {names}")]


def rgbd_scene(recording: Recording, options: RgbdOptions) -> Scene:
    """The scene of a recording, in metres, in the poses' own world frame."""
    root = recording.root
    if not recording.frames:
        reasons = "; ".join(
            finding.message for finding in recording.findings if finding.level == "warning"
        )
        raise ProjectError(
            f"{root}: no frame with picture and pose{f' ({reasons})' if reasons else ''}; "
            "expected at least one"
        )
    frames = sorted(recording.frames, key=lambda frame: natural_key(frame.name))
    color_K = recording.color_K if options.color_K is None else options.color_K
    K = _corner_origin(color_K, what=f"{root}, colour intrinsics")
    registration = _registration(recording, options, K)
    unit = recording.depth_unit if options.depth_unit is None else float(options.depth_unit)
    reader = partial(read_depth, unit=unit, maximum=options.depth_max)
    size = _common_size(frames)
    lens = _lens(K, recording, options, size=size)
    photographs, defects = [], []
    for frame in frames:
        pose, defect = rigid_transform(frame.world_from_cam, what=frame.where)
        defects.append(defect)
        photographs.append(
            Photograph(
                frame.name,
                frame.color,
                lens,
                invert_rigid(pose),
                None,
                frame.depth,
                reader,
                registration,
            )
        )
    findings = [
        *recording.findings,
        *rotation_findings(defects),
        *lens_findings([item.lens for item in photographs]),
        *header_findings([(item.image, size) for item in photographs]),
        *_intrinsics_findings(K, size),
        *_depth_findings(photographs, size, registration, unit=unit),
    ]
    views = tuple(item.view() for item in photographs)
    return Scene(root, "rgbd", views, None, tuple(findings), metric=True)


def _corner_origin(K: ArrayLike, *, what: str) -> Float64:
    """Published intrinsics, whose first pixel centre is (0, 0), moved to (0.5, 0.5)."""
    matrix = np.array(K, np.float64)
    if matrix.shape == (4, 4):
        matrix = matrix[:3, :3]
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise ProjectError(f"{what}: {np.asarray(K).tolist()}; expected a finite 3x3 matrix")
    off = [matrix[0, 1], matrix[1, 0], matrix[2, 0], matrix[2, 1], matrix[2, 2] - 1]
    if min(matrix[0, 0], matrix[1, 1]) <= 0 or np.abs(off).max() > 1e-6:
        raise ProjectError(
            f"{what}: {matrix.tolist()}; expected [fx 0 cx; 0 fy cy; 0 0 1] with fx, fy > 0"
        )
    matrix[:2, 2] += 0.5
    return matrix


def _registration(recording: Recording, options: RgbdOptions, K: Float64) -> Registration | None:
    depth_K = recording.depth_K if options.depth_K is None else options.depth_K
    moved = (
        recording.color_from_depth if options.color_from_depth is None else options.color_from_depth
    )
    if depth_K is None and moved is None:
        return None
    if depth_K is None:
        raise OptionError(
            f"{recording.root}: color_from_depth is given without depth_K; expected both; give the "
            "depth camera's intrinsics"
        )
    transform = np.eye(4)
    if moved is not None:
        transform, _ = rigid_transform(moved, what=f"{recording.root}, color_from_depth")
    return Registration(
        _corner_origin(depth_K, what=f"{recording.root}, depth intrinsics"), transform
    )


def _common_size(frames: Sequence[RgbdFrame]) -> tuple[int, int]:
    """Width and height of the first readable picture; the others are checked against it."""
    for frame in frames:
        try:
            header = read_header(frame.color)
        except ProjectError:
            continue
        return header.width, header.height
    raise ProjectError(f"{frames[0].color}: unreadable, like all {len(frames)} pictures beside it")


def _lens(K: Float64, recording: Recording, options: RgbdOptions, *, size: tuple[int, int]) -> Any:
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    what = f"{recording.root}, colour camera"
    if options.distortion is not None:
        distortion: Sequence[float] = options.distortion
        if len(distortion) != 5 or not np.isfinite(distortion).all():
            raise OptionError(
                f"{what}: distortion {distortion}; expected five numbers k1, k2, p1, p2, k3"
            )
    else:
        # What a layout publishes belongs to the intrinsics that it publishes.
        distortion = recording.distortion if options.color_K is None else ()
    if any(distortion):
        params += [*distortion, 0.0, 0.0, 0.0]
        return undistortion("FULL_OPENCV", params, size, what=what)
    return undistortion("PINHOLE", params, size, what=what)


def _intrinsics_findings(K: Float64, size: tuple[int, int]) -> list[Finding]:
    x, y = K[0, 2] / size[0], K[1, 2] / size[1]
    if 0.25 < x < 0.75 and 0.25 < y < 0.75:
        return []
    return [
        Finding(
            "warning",
            f"the principal point ({K[0, 2]:.1f}, {K[1, 2]:.1f}) is far from the middle of "
            f"{size[0]}x{size[1]} pixels: are the intrinsics of another size?",
        )
    ]


def _depth_findings(
    photographs: Sequence[Photograph],
    size: tuple[int, int],
    registration: Registration | None,
    *,
    unit: float,
) -> list[Finding]:
    with_depth = [item.depth for item in photographs if item.depth is not None]
    findings = []
    if len(with_depth) < len(photographs):
        findings.append(
            Finding("warning", f"{len(photographs) - len(with_depth)} frames have no depth map")
        )
    if not with_depth:
        return findings
    findings.append(Finding("info", f"depth unit: {unit:.6g} m"))
    if registration is not None:
        findings.append(Finding("info", "depth is registered into the colour camera"))
        return findings
    findings += depth_findings([(path, size) for path in with_depth], _depth_size)
    findings.append(Finding("info", "depth is taken as seen by the colour camera (no depth_K)"))
    return findings


def _depth_size(path: Path) -> tuple[int, int]:
    header = read_header(path)
    if header.mode in ("L", "P", "RGB", "RGBA"):
        raise ProjectError(f"{path}: 8-bit depth ({header.mode}); expected 16-bit grey")
    return header.width, header.height
