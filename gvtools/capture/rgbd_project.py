"""From an RGB-D recording without poses to a posed project, in the layout of 7-Scenes.

``frame-NNNNNN.color.*``, ``.depth.png`` and ``.pose.txt``, ``camera-intrinsics.txt``, ``rgbd.json``
and ``capture.json``, a report. Pictures and depth maps are the recording's own files. All of it
appears at once, when it is complete.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras, Float64, rigid_poses
from gvtools.capture.mapping import Say
from gvtools.capture.project import REPORT, replaced_folder
from gvtools.errors import ProjectError
from gvtools.files import link_or_copy, write_json
from gvtools.poses.recording import RecordingPoses, RgbdFrames, find_poses
from gvtools.scenes.calibration import INTRINSICS
from gvtools.scenes.images import UNREADABLE, read_depth
from gvtools.scenes.matching import named
from gvtools.scenes.rgbd import SIDECAR, Recording, RgbdOptions, resolve_options, rgbd_scene
from gvtools.scenes.rgbd_layouts import UNPOSED, read_unposed
from gvtools.scenes.scene import Finding, Scene
from gvtools.trajectories import level_up
from gvtools.untrusted import open_picture

# Keyframes whose depth the picture shows.
DRAWN = 12
# Loops that still miss by this (median) tell of wrong intrinsics, or of too fast a motion.
DOUBTFUL_MM = 30.0
# All digits of float64.
DIGITS = "%.17g"


@dataclass(frozen=True, kw_only=True)
class RgbdCaptureReport:
    """What the capture of an RGB-D recording found."""

    source: str  # absolute path of the input
    pictures: int  # frames with depth that were tried
    registered: tuple[str, ...]  # names of those with a pose, in order of time
    left_out: dict[str, str]  # file of the recording and reason of each other one
    sources: dict[str, str]  # file of the recording that each registered frame's picture is
    matching: str  # how pairs were chosen
    # Pairs of frames, and the share of each first one's depth that the second sees.
    overlap: tuple[tuple[str, str, float], ...]
    other_parts: tuple[int, ...]  # frames of further connected parts, the largest first
    keyframes: tuple[str, ...]  # names of the frames that loops were looked for among
    loops: tuple[tuple[str, str], ...]  # pairs of keyframes that close loops
    # Median and greatest residual of loops on the chain of neighbours: millimetres and degrees;
    # None where no loop says it.
    drift: dict[str, float] | None
    residuals: dict[str, float] | None  # the same after optimisation
    path_m: float  # length of the path, metres
    cameras: tuple[dict[str, Any], ...]  # model and parameters of the camera
    metric: bool = True  # True
    # "first frame": the world's frame is that of the first frame's camera.
    placed_by: str = "first frame"
    findings: tuple[Finding, ...] = ()  # what was met


def capture_rgbd(
    source: Path,
    out: Path,
    *,
    options: RgbdOptions | None = None,
    say: Say = lambda text: None,
    draw: Callable[[Path, RgbdCaptureReport], object] = lambda folder, report: None,
) -> RgbdCaptureReport:
    """Find the poses of an RGB-D recording, and write a project.

    The source is a folder of colour and depth or a ``.bag``, ``out`` absent or empty; options say
    what the folder does not. ``draw`` adds pictures to the project before it gets its name.
    """
    with replaced_folder(out) as work:
        folder = source
        if source.is_file():
            folder = work / "recording"
            say(f"taking {source} apart")
            unit = unpack_bag(source, folder)
            options = (options or RgbdOptions()).replaced(depth_unit=unit)
        recording, scene = _read(folder, options)
        say(f"comparing {len(scene)} frames")
        found = find_poses(RgbdFrames(scene), say=say)
        if len(found.poses) < 2:
            raise ProjectError(
                f"{source}: no two of {len(scene)} frames agree in colour and depth; expected "
                "neighbours that share most of what they show; look at --color-intrinsics, "
                "--depth-intrinsics and --depth-unit, and record with slower motion"
            )
        names = _names(recording)
        report = _report(scene, found, names, source=source, sources=recording)
        _write(work, recording, found=found, names=names)
        write_json(work / REPORT, asdict(report))
        shutil.rmtree(work / "recording", ignore_errors=True)
        draw(work, report)
    return report


def unpack_bag(bag: Path, folder: Path) -> float:
    """Write a RealSense recording in Redwood's layout to a new folder; metres a unit of depth.

    The recording has one colour and one depth stream of the same rate; depth is registered to
    colour.
    """
    from gvtools.o3d import o3d

    if not hasattr(o3d.t.io, "RSBagReader"):
        raise ProjectError(
            f"{bag}: this machine's Open3D has no reader of RealSense recordings (its packages for "
            "x86-64 have one); convert it to folders color and depth there"
        )
    units = 0.0
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        try:
            reader = o3d.t.io.RGBDVideoReader.create(str(bag))
            if reader.is_opened():
                units = float(reader.metadata.depth_scale)
                reader.save_frames(str(folder))
        except RuntimeError:
            units = 0.0
    if not (folder / "color").is_dir() or not units > 0:
        raise ProjectError(
            f"{bag}: Open3D cannot read it; expected a recording by librealsense with a colour "
            "(RGB8) and a depth stream (Z16) of the same rate"
        )
    return 1 / units


def _read(source: Path, options: RgbdOptions | None) -> tuple[Recording, Scene]:
    """The recording in the order of its scene's views, and the scene."""
    resolved, met = resolve_options(source, options)
    recording = read_unposed(source, resolved)
    if recording is None:
        raise ProjectError(f"{source}: no RGB-D recording; expected one of: {'; '.join(UNPOSED)}")
    if len(recording.frames) < 2:
        raise ProjectError(
            f"{source}: {len(recording.frames)} frames with picture and depth; expected at least "
            "two that overlap; look whether names of pictures and depth maps belong together"
        )
    unreadable = []
    for frame in recording.frames:
        try:
            with open_picture(frame.image) as picture:
                picture.load()
            if frame.depth is not None:
                read_depth(frame.depth)
        except (*UNREADABLE, ProjectError):
            unreadable.append(frame.name)
    if unreadable:
        text = (
            f"{len(unreadable)} of {len(recording.frames)} frames have a picture or depth map that "
            f"cannot be read: left out ({named(unreadable)}); copy these again"
        )
        met = [*met, Finding("warning", text)]
        kept = [frame for frame in recording.frames if frame.name not in unreadable]
        if len(kept) < 2:
            raise ProjectError(f"{source}: {text}; expected at least two that overlap")
        recording = replace(recording, frames=kept)
    recording = replace(recording, findings=[*met, *recording.findings])
    scene = rgbd_scene(recording)
    frames = {frame.name: frame for frame in recording.frames}
    return replace(recording, frames=[frames[name] for name in scene.names]), scene


def _names(recording: Recording) -> list[str]:
    """Names of the project's pictures: 7-Scenes' own stay, others are numbered in order."""
    images = [frame.image for frame in recording.frames]
    return [
        image.name if ".color." in image.name else f"frame-{i:06d}.color{image.suffix.lower()}"
        for i, image in enumerate(images)
    ]


def _write(
    work: Path, recording: Recording, *, found: RecordingPoses, names: Sequence[str]
) -> None:
    """The project's files but the report."""
    for number, pose in found.poses.items():
        frame = recording.frames[number]
        assert frame.depth is not None
        stem = names[number][: names[number].rindex(".color.")]
        link_or_copy(frame.image, work / names[number])
        link_or_copy(frame.depth, work / f"{stem}.depth{frame.depth.suffix}")
        np.savetxt(work / f"{stem}.pose.txt", pose, fmt=DIGITS)
    options = recording.options
    np.savetxt(work / INTRINSICS, np.asarray(options.color_K)[:3, :3], fmt=DIGITS)
    fields = ("depth_unit", "depth_K", "color_from_depth", "distortion", "depth_max")
    given = {name: getattr(options, name) for name in fields}
    write_json(work / SIDECAR, {name: x for name, x in given.items() if x is not None})


def _report(
    scene: Scene, found: RecordingPoses, names: Sequence[str], *, source: Path, sources: Recording
) -> RgbdCaptureReport:
    kept = sorted(found.poses)
    files = [os.path.relpath(frame.image, sources.root) for frame in sources.frames]
    left_out = {
        files[number]: f"agrees with {len(part) - 1} other frames, and none of the largest part"
        if len(part) > 1
        else "agrees with no other frame"
        for part in found.parts[1:]
        for number in part
    }
    camera = scene.views[0].camera
    centres = np.array([found.poses[number][:3, 3] for number in kept])
    return RgbdCaptureReport(
        source=str(source.resolve()),
        pictures=len(scene),
        registered=tuple(names[number] for number in kept),
        left_out=left_out,
        sources={names[number]: files[number] for number in kept},
        matching="neighbours in time, and keyframes that look alike or are near",
        overlap=tuple(
            (names[pair.target], names[pair.source], round(pair.overlap, 4)) for pair in found.pairs
        ),
        other_parts=tuple(len(part) for part in found.parts[1:]),
        keyframes=tuple(names[number] for number in found.keyframes),
        loops=tuple((names[pair.target], names[pair.source]) for pair in found.loops),
        drift=_summary(found.drift),
        residuals=_summary(found.residuals),
        path_m=float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum()),
        cameras=(
            {
                "model": "PINHOLE",
                "width": int(camera.width[0]),
                "height": int(camera.height[0]),
                "params": [float(camera.K[0][at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))],
            },
        ),
        findings=tuple([*scene.findings, *_findings(found, left_out, count=len(scene))]),
    )


def points_from_above(scene: Scene, keyframes: Sequence[str]) -> tuple[Cameras, Float64]:
    """Cameras and (N, 3) points of a captured project, turned so that z is up, for its picture.

    Keyframes give points, of many DRAWN.
    """
    cameras = scene.cameras
    turn = Rotation.align_vectors([[0, 0, 1]], [level_up(cameras)])[0]
    whole = rigid_poses(turn.as_matrix())
    shown = [name for name in keyframes if name in set(scene.names)]
    points = []
    for name in shown[:: max(1, len(shown) // DRAWN)]:
        view = scene[name]
        depth = view.load().depth
        assert depth is not None
        local = (view.camera.rays() * depth[..., None])[::12, ::12]
        pose = view.camera.world_from_cam[0]
        points.append(turn.apply(local[local[..., 2] > 0] @ pose[:3, :3].T + pose[:3, 3]))
    turned = replace(cameras, cam_from_world=cameras.cam_from_world @ whole.T)
    return turned, np.concatenate([np.zeros((0, 3)), *points])


def _summary(rows: Float64) -> dict[str, float] | None:
    if not len(rows):
        return None
    figures = {"median": np.median(rows, axis=0), "max": rows.max(axis=0)}
    return {
        f"{how}_{unit}": float(values[column])
        for column, unit in enumerate(("mm", "deg"))
        for how, values in figures.items()
    }


def _findings(found: RecordingPoses, left_out: dict[str, str], *, count: int) -> list[Finding]:
    miss = float(np.median(found.residuals[:, 0])) if found.loops else 0.0
    met = (
        (left_out, f"{len(left_out)} of {count} frames could not be connected "
         f"({named(list(left_out))}): left out; record with slower motion, and nothing nearer than "
         "the depth camera's range"),
        (not found.loops, "no loop closes: drift cannot be told; let the camera return to where it "
         "has been, and record more frames a second"),
        (miss > DOUBTFUL_MM, f"loops miss by {miss:.0f} mm (median) after optimisation: the poses "
         "are doubtful; look at the intrinsics, and record with slower motion"),
    )  # fmt: skip
    return [Finding("warning", text) for there, text in met if there]
