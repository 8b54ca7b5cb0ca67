"""RGB-D folders: what their layouts share, from options and frames to a scene.

Poses are camera-to-world with OpenCV's axes, but NeuralRGBD's; depth is 16-bit with 0 and 65535 for
no reading, or float. Layouts publish intrinsics whose first pixel centre is (0, 0), as Kinect
drivers and Open3D count; they are moved by half a pixel to the project's (0.5, 0.5) here, once.
The layouts are in ``rgbd_layouts``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BeforeValidator, Field

from gvtools.cameras import rigid_transform
from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.calibration import (
    INTRINSICS,
    MILLIMETRES,
    Float64,
    corner_origin,
    exported_file,
    exported_intrinsics,
    load_matrix,
    pinhole_lens,
    sensor_default,
    times_as_large,
)
from gvtools.scenes.images import holds_fractions, read_depth
from gvtools.scenes.photographs import NO_POSE, PosedFrame, Registration, first_size, posed_scene
from gvtools.scenes.scene import Finding, Scene
from gvtools.scenes.undistort import LensParameters
from gvtools.settings import Settings, changes, with_file

SIDECAR = "rgbd.json"
Matrix = Annotated[list[list[float]], BeforeValidator(lambda value: np.asarray(value).tolist())]


class RgbdOptions(Settings):
    """What a posed RGB-D folder does not tell by itself; None means the layout's own value.

    The same names may stand in a file ``rgbd.json`` in the folder; values given here win.
    Intrinsics are as published with such recordings: the first pixel's centre is (0, 0).
    """

    section = "rgbd"

    depth_unit: float | None = Field(None, gt=0)
    """Metres per stored unit (TUM 1/5000, Replica by its file, float maps 1, others 1/1000)."""
    color_K: Matrix | None = None
    """(3, 3) intrinsics of the colour camera, pixels."""
    depth_K: Matrix | None = None
    """(3, 3) intrinsics of the depth camera, pixels; None: depth is of the colour camera."""
    color_from_depth: Matrix | None = None
    """(4, 4) rigid, metres; None with ``depth_K`` given: the layout's, or the same place."""
    distortion: list[float] | None = None
    """k1, k2, p1, p2, k3 of the colour camera, as OpenCV has them."""
    depth_max: float | None = Field(None, gt=0)
    """Metres; greater readings are ignored."""
    max_time_difference: float = Field(0.02, gt=0)
    """Seconds between colour, depth and pose of one frame (TUM)."""


@dataclass(frozen=True, eq=False)
class Recording:
    """RGB-D frames, poses world_from_cam, and options: the user's over the layout's."""

    root: Path
    options: RgbdOptions  # ``color_K`` and ``depth_unit`` are known
    frames: Sequence[PosedFrame] = ()
    unposed: str = NO_POSE  # why frames without a pose are left out
    given: frozenset[str] = frozenset()  # the intrinsics that are the user's word
    findings: Sequence[Finding] = ()


def under(options: RgbdOptions, **values: object) -> RgbdOptions:
    """The options with what a layout says, where they say nothing."""
    absent = {name: value for name, value in values.items() if getattr(options, name) is None}
    return options.replaced(**absent)


def given_intrinsics(options: RgbdOptions) -> frozenset[str]:
    """The intrinsics that are the user's word, by their options' names."""
    return frozenset(name for name in ("color_K", "depth_K") if getattr(options, name) is not None)


class RgbdFolder(ABC):
    """An RGB-D layout, with poses or without."""

    name: str
    holds: tuple[str, str]  # with poses and without, for messages
    unit = MILLIMETRES  # metres per stored unit of depth
    assumed = True  # whether a sensor's default is taken where nothing has intrinsics

    @abstractmethod
    def matches(self, root: Path, *, posed: bool = True) -> bool:
        """Whether a folder is of this layout, going by its files' names."""

    @abstractmethod
    def frames(self, root: Path, options: RgbdOptions) -> list[PosedFrame]:
        """The pictures in order of time, with their depth maps, no poses yet."""

    def frames_of_poses(self, root: Path) -> list[PosedFrame]:
        """The frames that files of a pose each tell of, with a picture or without."""
        return []

    def calibration(self, root: Path, options: RgbdOptions) -> Recording:
        """A recording that has no frames yet."""
        maps = (frame.depth for frame in self.frames(root, options) if frame.depth is not None)
        first = next(filter(Path.is_file, maps), None)
        unit = self.unit if first is None or not holds_fractions(first) else 1.0
        cameras = {"color": options.color_K, "depth": options.depth_K}
        found = [
            exported_intrinsics(root, camera) if K is None else [] for camera, K in cameras.items()
        ]
        color_K, depth_K = (there[0][0] if there else None for there in found)
        merged = under(options, depth_unit=unit, color_K=color_K, depth_K=depth_K)
        if merged.color_K is None:
            return self.uncalibrated(root, merged)
        findings = [
            Finding("warning", f"{other} differs from {name}, which is read; take the wrong away")
            for (K, name), *others in filter(None, found)
            for another, other in others
            if not np.allclose(another, K, rtol=1e-3)
        ]
        if merged.depth_K is None:
            line = [Finding("info", f"intrinsics: {found[0][0][1]}")] if found[0] else []
            return Recording(root, merged, findings=[*line, *findings])
        # Camera from rig each; an export without such files has one place for both.
        color, depth = (
            rigid_transform(load_matrix(path, (4, 4)), what=str(path))[0]
            if path.is_file()
            else np.eye(4)
            for path in (exported_file(root, f"extrinsic_{camera}.txt") for camera in cameras)
        )
        moved = color @ np.linalg.inv(depth)
        if options.color_from_depth is None and not np.allclose(moved, np.eye(4)):
            # Exports with other than identity are rare, and tools read them both ways.
            message = "extrinsics are taken as camera-from-rig; if not, give color_from_depth"
            findings.append(Finding("warning", message))
        return Recording(root, under(merged, color_from_depth=moved), findings=findings)

    def uncalibrated(self, root: Path, options: RgbdOptions) -> Recording:
        """A recording where neither an option nor a file has intrinsics."""
        if not self.assumed:
            raise ProjectError(
                f"{root}: no {INTRINSICS} there or in the parent folder, no intrinsic_color.txt; "
                "expected three lines 'fx 0 cx', '0 fy cy', '0 0 1'; write one, or give color_K "
                "(--color-intrinsics)"
            )
        pictures = (frame.image for frame in self.frames(root, options))
        K, finding = sensor_default(first_size(pictures))
        return Recording(root, under(options, color_K=K), findings=[finding])

    def posed(self, recording: Recording, *, strict: bool) -> Recording:
        """The recording with its frames and their poses; only a strict one minds damaged ones."""
        frames = self.frames(recording.root, recording.options)
        known = {frame.where for frame in frames}
        others = self.frames_of_poses(recording.root)
        frames += [frame for frame in others if frame.where not in known]
        return replace(recording, frames=[_with_pose(frame, strict=strict) for frame in frames])

    def record(self, root: Path, options: RgbdOptions, *, strict: bool = True) -> Recording:
        """The frames, poses and calibration of a folder."""
        calibrated = replace(self.calibration(root, options), given=given_intrinsics(options))
        return self.posed(calibrated, strict=strict)

    def read(self, root: Path, *, options: RgbdOptions | None = None) -> Scene:
        """A folder with poses as a scene, metric, in the poses' own world frame."""
        resolved, findings = resolve_options(root, options)
        recording = self.record(root, resolved)
        return rgbd_scene(replace(recording, findings=[*findings, *recording.findings]))


def _with_pose(frame: PosedFrame, *, strict: bool) -> PosedFrame:
    """The frame with the pose in its own file."""
    path = Path(frame.where)
    try:
        told = path.is_file() and path.stat().st_size  # an empty file tells nothing
        return replace(frame, pose=load_matrix(path, (4, 4), (3, 4))) if told else frame
    except ProjectError:
        if strict:
            raise
        return frame


def resolve_options(root: Path, options: RgbdOptions | None) -> tuple[RgbdOptions, list[Finding]]:
    """``options`` over those of the folder's ``rgbd.json``, and a finding when that was read."""
    options = options or RgbdOptions()
    path = Path(root) / SIDECAR
    if not path.is_file():
        return options, []
    read = with_file(RgbdOptions(), path)
    merged = read.replaced(**{name: getattr(options, name) for name in options.model_fields_set})
    names = ", ".join(sorted(changes(RgbdOptions(), read)))
    return merged, [Finding("info", f"options read from {SIDECAR}: {names}")]


def rgbd_scene(recording: Recording, *, kind: str = "rgbd", strict: bool = True) -> Scene:
    """The scene of a recording, in metres, in the poses' own world frame."""
    root, frames, options = recording.root, recording.frames, recording.options
    size = first_size(frame.image for frame in frames)
    K = corner_origin(np.array(options.color_K), what=f"{root}, colour intrinsics")
    K, lines = _of_size(K, size, what="the colour camera", given="color_K" in recording.given)
    registration = _registration(root, options)
    if registration is not None:
        of_depth = first_size(frame.depth for frame in frames if frame.depth is not None)
        given = "depth_K" in recording.given
        depth_K, others = _of_size(
            registration.depth_K, of_depth, what="the depth camera", given=given
        )
        registration, lines = replace(registration, depth_K=depth_K), [*lines, *others]
    if size is None and frames and strict:
        what = "unreadable" if frames[0].image.exists() else "no such picture"
        raise ProjectError(f"{frames[0].image}: {what}, like all {len(frames)} pictures beside it")
    lens = _lens(K, recording, size=size or (2, 2))
    own = lens if "color_K" in recording.given else None
    unit = options.depth_unit or MILLIMETRES
    reader = partial(read_depth, unit=unit, maximum=options.depth_max)
    scene = posed_scene(
        root,
        [
            replace(
                frame, lens=own or frame.lens or lens, read_depth=reader, registration=registration
            )
            for frame in frames
        ],
        poses="world_from_cam",
        metric=True,
        kind=kind,
        strict=strict,
        findings=[*recording.findings, *lines],
        unposed=recording.unposed,
        advice="give its pictures and poses",
    )
    findings = [*scene.findings]
    if not any(view.has_depth for view in scene):
        findings.append(Finding("warning", f"none of {len(scene)} frames has a depth map"))
    else:
        findings.append(Finding("info", f"depth unit: {unit:.6g} m"))
        if registration is not None:
            findings.append(Finding("info", "depth is registered into the colour camera"))
        elif strict:
            line = "depth is taken as seen by the colour camera (no depth_K)"
            findings.append(Finding("info", line))
    return replace(scene, findings=tuple(findings))


def _of_size(
    K: Float64, size: tuple[int, int] | None, *, what: str, given: bool
) -> tuple[Float64, list[Finding]]:
    """(3, 3) scaled to a picture's size unless ``given``, told where they are of another size."""
    times = 1.0 if size is None else times_as_large(K[:2, 2], size)
    if size is None or times == 1:
        return K, []
    line = (
        f"{what}'s principal point ({K[0, 2]:g}, {K[1, 2]:g}) is the middle of pictures "
        f"{times:.4g} times as large as its own ({size[0]}x{size[1]}): intrinsics "
    )
    if given:
        return K, [Finding("warning", f"{line}used as given; give those of its own size")]
    line += "scaled"
    return np.diag([1 / times, 1 / times, 1]) @ K, [Finding("warning", line)]


def _registration(root: Path, options: RgbdOptions) -> Registration | None:
    if options.depth_K is None and options.color_from_depth is None:
        return None
    if options.depth_K is None:
        raise OptionError(
            f"{root}: color_from_depth is given without depth_K; expected both; give the depth "
            "camera's intrinsics"
        )
    transform = np.eye(4)
    if options.color_from_depth is not None:
        transform, _ = rigid_transform(options.color_from_depth, what=f"{root}, color_from_depth")
    return Registration(corner_origin(options.depth_K, what=f"{root}, depth intrinsics"), transform)


def _lens(K: Float64, recording: Recording, *, size: tuple[int, int]) -> LensParameters:
    lens, distortion = pinhole_lens(K, size), recording.options.distortion
    if distortion is None:
        return lens
    if len(distortion) != 5 or not np.isfinite(distortion).all():
        raise OptionError(
            f"{recording.root}, colour camera: distortion {distortion}; expected five numbers k1, "
            "k2, p1, p2, k3"
        )
    if not any(distortion):
        return lens
    return LensParameters("FULL_OPENCV", (*lens.values, *distortion, 0.0, 0.0, 0.0), size)
