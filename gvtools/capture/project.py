"""From photographs or a video to a COLMAP project that every command reads.

``images/``, ``sparse/0`` (the largest model that was found, placed in the world) and
``capture.json``, a report. The folder gets its name when it is complete.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras
from gvtools.capture import video
from gvtools.capture.mapping import MappingResult, MappingTask, Say, find_cameras
from gvtools.capture.panoramas import (
    fisheye_params,
    lens_of,
    panorama_pairs,
    rename_faces,
    write_faces,
)
from gvtools.capture.photographs import (
    CapturedPhotograph,
    complete_masks,
    copy_upright,
    find_photographs,
)
from gvtools.colmap import pycolmap
from gvtools.errors import OptionError, ProjectError
from gvtools.features import LightGlueMatcher
from gvtools.files import write_json
from gvtools.poses.colmap import SEED
from gvtools.runs.folder import folder_lock
from gvtools.scenes.matching import named
from gvtools.scenes.scene import Finding
from gvtools.scenes.undistort import face_name, picture_of
from gvtools.trajectories import level_up

REPORT = "capture.json"
IMAGES, MODEL = "images", "sparse/0"
# A model in which a smaller share of the matches became points is likely to be wrong.
DOUBTFUL = 0.75
# Error of a phone's or a drone's GPS; positions that spread by less than twice this are not used.
# [metres]
GPS_ERROR = 5.0
# Pictures with GPS that are needed to place a model.
LEAST_PLACED = 3


@dataclass(frozen=True, kw_only=True)
class CaptureReport:
    """What a capture found."""

    source: str  # absolute path of the input
    pictures: int  # number of readable, different pictures
    registered: tuple[str, ...]  # names of those with a camera, in natural order
    left_out: dict[str, str]  # reason for each other picture, by name
    # Mean reprojection error of the triangulated points, pixels; None without any.
    reprojection_px: float | None
    points: int  # number of triangulated points
    track_length: float  # mean number of pictures that a point is seen in
    # Share of the verified matches that became points, 0 to 1; low for a wrong model; None for
    # poses that were given.
    explained: float | None
    mapping: str  # "global" or "incremental", or whose poses and how they were adjusted
    features: str  # "sift", "aliked" or "disk"
    matching: str  # how pairs were chosen, in words
    # Number of pictures of each further model, not connected to this one.
    other_models: tuple[int, ...]
    # Pairs of pictures, and the number of their verified matches.
    overlap: tuple[tuple[str, str, int], ...]
    # Model, size and parameters of each camera, as COLMAP has them.
    cameras: tuple[dict[str, Any], ...]
    metric: bool  # whether units are metres
    placed_by: str  # "GPS", "distance" or "cameras", see ``place``
    # Latitude and longitude [degrees] and height [m] of the origin; None without GPS.
    origin: tuple[float, float, float] | None
    findings: tuple[Finding, ...] = ()  # notes and warnings


def capture_photographs(
    source: Path,
    out: Path,
    *,
    frames: int | None = None,
    masks: Path | None = None,
    distance: tuple[str, str, float] | None = None,
    learned: LightGlueMatcher | None = None,
    lens: str = "auto",
    say: Say = lambda text: None,
    draw: Callable[[Path, CaptureReport], object] = lambda folder, report: None,
) -> CaptureReport:
    """Find the cameras of a folder's photographs, or of a video's frames, and write a project.

    Args:
        out: the project's folder; absent or empty.
        frames: how many frames of a video to take; None goes by its motion, see ``video``.
        masks: folder of ``NAME.png``, black where no features are to be found; not for videos.
        distance: names of two pictures and the distance between their places, metres.
        learned: finds and matches features; None takes COLMAP's SIFT.
        lens: "perspective", "equirectangular" (panoramas, which are cut into faces), "fisheye", or
            "auto": recognised from the pictures.
        draw: adds pictures to the project's folder before it gets its name.
    """
    is_video = source.is_file()
    if is_video and masks is not None:
        raise OptionError("--masks: masks are of photographs; a video's frames have no names yet")
    if not is_video and frames is not None:
        raise OptionError(f"--frames: {source} is a folder of pictures; all of them are tried")
    with replaced_folder(out) as work:
        folder = source
        findings: list[Finding] = []
        if is_video:
            folder = work / "frames"
            picked = video.pick_frames(
                source, folder, count=frames, progress=lambda n: say(f"{n} frames looked at")
            )
            findings += picked.findings(source.name)
        photographs, met = find_photographs(folder)
        findings += met
        if masks is not None:
            findings += complete_masks(photographs, masks, out=work / "whole_masks")
            masks = work / "whole_masks"
        try:
            mapped = _map(
                photographs, work, source=source, lens=lens_of(photographs, lens),
                is_video=is_video, masks=masks, learned=learned, say=say,
            )  # fmt: skip
        except ProjectError as error:
            # What was met may explain it.
            warnings = [finding.message for finding in findings if finding.level == "warning"]
            also = f"; also: {'; '.join(warnings)}" if warnings else ""
            raise ProjectError(f"{error}{also}") from error
        locations = {item.name: item.location for item in photographs if item.location}
        placement, met = place(mapped.model, locations=locations, distance=distance)
        findings += met
        features = "sift" if learned is None else learned.name
        report = _report(
            source, photographs, mapped=mapped, placement=placement, features=features,
            findings=findings,
        )  # fmt: skip
        (work / MODEL).mkdir(parents=True)
        mapped.model.write_binary(str(work / MODEL))
        write_json(work / REPORT, asdict(report))
        for spare in ("mapping", "frames", "whole_masks"):
            shutil.rmtree(work / spare, ignore_errors=True)
        draw(work, report)
    return report


def _map(
    photographs: Sequence[CapturedPhotograph],
    work: Path,
    *,
    source: Path,
    lens: str,
    is_video: bool,
    masks: Path | None,
    learned: LightGlueMatcher | None,
    say: Say,
) -> MappingResult:
    """Write the pictures of the project, and find their cameras."""
    (work / "mapping").mkdir()
    task = MappingTask(
        work / IMAGES, (), work / "mapping", source=source, in_order=is_video, masks=masks,
        learned=learned, say=say,
    )  # fmt: skip
    if lens != "equirectangular":
        copy_upright(photographs, work / IMAGES)
        fisheye = fisheye_params(photographs) if lens == "fisheye" else ""
        if fisheye:
            say("pictures of a fisheye lens: mapped as OPENCV_FISHEYE")
        groups: dict[str, list[str]] = {}
        for item in photographs:
            groups.setdefault("" if is_video else item.camera, []).append(item.name)
        return find_cameras(replace(task, cameras=list(groups.values()), fisheye=fisheye))
    say(f"cutting {len(photographs)} panoramas into faces")
    face_masks = work / "masks"
    rigs = write_faces(photographs, work / IMAGES, masks=masks, face_masks=face_masks)
    faces = [rig.names(face) for rig in rigs for face in rig.faces]
    masks = None if masks is None else face_masks
    mapped = find_cameras(replace(task, cameras=faces, masks=masks, rigs=rigs))
    rename_faces(mapped.model, rigs, images=work / IMAGES, face_masks=face_masks)
    return replace(mapped, pairs=panorama_pairs(mapped.pairs))


@contextmanager
def replaced_folder(out: Path) -> Iterator[Path]:
    """A working folder beside ``out``, renamed to ``out`` at the end and removed after an error."""
    _refuse_filled(out)
    work = out.with_name(f".{out.name}.part")
    with folder_lock(work):
        try:
            # Another capture may have written it while this one waited for the lock.
            _refuse_filled(out)
            # Left by a capture that was killed.
            for path in work.iterdir():
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            yield work
            if out.is_dir():
                out.rmdir()
            work.rename(out)
        except OSError as error:
            raise ProjectError(
                f"{out}: cannot be written ({error.strerror or error}); free some space or choose "
                "another folder"
            ) from error
        finally:
            shutil.rmtree(work, ignore_errors=True)


def _refuse_filled(out: Path) -> None:
    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        raise ProjectError(
            f"{out}: is there already, and not empty; nothing is overwritten; give another --out"
        )


def camera_rows(model: pycolmap.Reconstruction) -> tuple[dict[str, Any], ...]:
    """Model, size and parameters of each camera."""
    return tuple(
        {
            "model": camera.model.name,
            "width": camera.width,
            "height": camera.height,
            "params": [float(value) for value in camera.params],
        }
        for camera in model.cameras.values()
    )


def _report(
    source: Path,
    photographs: Sequence[CapturedPhotograph],
    *,
    mapped: MappingResult,
    placement: WorldPlacement,
    features: str,
    findings: Sequence[Finding],
) -> CaptureReport:
    model = mapped.model
    there = {picture_of(image.name) for image in model.images.values() if image.has_pose}
    registered = [item.name for item in photographs if item.name in there]
    partners = Counter(name for pair in mapped.pairs for name in pair)
    left_out = {}
    for name in (item.name for item in photographs if item.name not in there):
        apart = [len(names) for names in mapped.others if name in names]
        left_out[name] = (
            f"in a further model of {apart[0]} pictures, which does not connect" if apart
            else f"overlaps with {partners[name]} pictures, and no camera fits them"
            if name in partners else "overlaps with no other picture"
        )  # fmt: skip
    sizes = ", ".join(str(len(names)) for names in mapped.others)
    look = "look at the picture of the cameras, and take more pictures from"
    met = (
        (left_out, f"{len(left_out)} of {len(photographs)} pictures have no camera "
         f"({named(list(left_out))}); take more pictures between these and the others"),
        (sizes, f"further models of {sizes} pictures do not connect to the largest: not kept"),
        (mapped.flat, "each pair of pictures is explained by a plane: focal length and depth hang "
         f"by little; {look} the side"),
        (mapped.explained < DOUBTFUL, f"{mapped.explained:.0%} of the matches became points: the "
         f"cameras are doubtful; {look} places in between"),
    )  # fmt: skip
    warnings = [Finding("warning", text) for there, text in met if there]
    return CaptureReport(
        source=str(source.resolve()),
        pictures=len(photographs),
        registered=tuple(registered),
        left_out=left_out,
        reprojection_px=float(model.compute_mean_reprojection_error()),
        points=int(model.num_points3D()),
        track_length=float(model.compute_mean_track_length()),
        explained=mapped.explained,
        mapping=mapped.how,
        features=features,
        matching=mapped.matching,
        other_models=tuple(len(names) for names in mapped.others),
        overlap=tuple((a, b, count) for (a, b), count in sorted(mapped.pairs.items())),
        cameras=camera_rows(model),
        metric=placement.metric,
        placed_by=placement.by,
        origin=placement.origin,
        findings=(*findings, *warnings),
    )


@dataclass(frozen=True)
class WorldPlacement:
    """How a model was placed."""

    metric: bool  # whether its units are metres
    by: str  # "GPS", "distance" (scale only) or "cameras" (which way is up only)
    # Latitude, longitude [degrees] and height [m] of its origin; None without GPS.
    origin: tuple[float, float, float] | None = None


def place(
    model: pycolmap.Reconstruction,
    *,
    locations: Mapping[str, tuple[float, float, float]],
    distance: tuple[str, str, float] | None = None,
) -> tuple[WorldPlacement, list[Finding]]:
    """Move, rotate and scale a model in place, all of which mapping leaves undetermined.

    With GPS the world is metric, with x east, y north and z up. Otherwise z is up as the cameras
    were held, see ``level_up``, x and y are arbitrary, and so is the scale without a distance.
    Locations are latitude and longitude [degrees] and height [m] of pictures by name; the distance
    is that of the places where two pictures were taken, metres.
    """
    images = {name: _registered(model, name) for name in locations}
    placed = {image.name: locations[name] for name, image in images.items() if image is not None}
    placement: WorldPlacement | None = None
    findings: list[Finding] = []
    if len(placed) >= LEAST_PLACED:
        placement, findings = _by_gps(model, placed)
    if placement is None:
        _level(model)
        placement = WorldPlacement(metric=False, by="cameras")
    if distance is not None:
        first, second, metres = distance
        ends = []
        for name in (first, second):
            image = _registered(model, name)
            if image is None:
                raise OptionError(
                    f"--distance: {name!r} is no registered picture; give two that are"
                )
            ends.append(image.projection_center())
        apart = float(np.linalg.norm(ends[0] - ends[1]))
        if apart <= 1e-9:
            raise OptionError(f"--distance: {first!r} and {second!r} were taken at one place")
        identity = pycolmap.Rotation3d(np.array([0.0, 0.0, 0.0, 1.0]))
        model.transform(pycolmap.Sim3d(metres / apart, identity, np.zeros(3)))
        placement = WorldPlacement(True, "distance", placement.origin)
    return placement, findings


def _registered(model: pycolmap.Reconstruction, name: str) -> pycolmap.Image | None:
    # All faces of a panorama are at its place.
    image = model.find_image_with_name(name) or model.find_image_with_name(face_name(name, "front"))
    return image if image is not None and image.has_pose else None


def _by_gps(
    model: pycolmap.Reconstruction, placed: Mapping[str, tuple[float, float, float]]
) -> tuple[WorldPlacement | None, list[Finding]]:
    names, values = list(placed), np.array(list(placed.values()))
    origin = values.mean(axis=0)
    east = np.asarray(pycolmap.GPSTransform().ellipsoid_to_enu(values, *origin))
    east -= east.mean(axis=0)
    spread = float(np.linalg.norm(east[:, :2], axis=1).max())
    if spread < 2 * GPS_ERROR:
        text = (
            f"GPS of {len(names)} pictures spreads over {spread:.1f} m alone, about what it errs "
            "by: not used; give --distance for metres"
        )
        return None, [Finding("info", text)]
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = GPS_ERROR, SEED
    moved = pycolmap.align_reconstruction_to_locations(model, names, east, LEAST_PLACED, options)
    if moved is None:
        text = f"GPS of {len(names)} pictures contradicts the cameras that were found: not used"
        return None, [Finding("warning", text)]
    model.transform(moved)
    images = {image.name: image for image in model.images.values()}
    found = np.array([images[name].projection_center() for name in names])
    error = float(np.median(np.linalg.norm(found - east, axis=1)))
    text = f"placed by GPS of {len(names)} pictures, which it differs from by {error:.2f} m"
    latitude, longitude, height = origin.tolist()
    placement = WorldPlacement(True, "GPS", (latitude, longitude, height))
    return placement, [Finding("info", text)]


def _level(model: pycolmap.Reconstruction) -> None:
    """Rotate the vertical, as the cameras were held, to +z, and move their mean centre to 0."""
    images = [image for image in model.images.values() if image.has_pose]
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    poses[:, :3] = [image.cam_from_world().matrix() for image in images]
    cameras = Cameras.alike(np.eye(3), poses, size=(1, 1))
    turn = Rotation.align_vectors([[0.0, 0.0, 1.0]], [level_up(cameras)])[0]
    shift = -turn.apply(cameras.centers.mean(axis=0))
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(turn.as_quat()), shift))
