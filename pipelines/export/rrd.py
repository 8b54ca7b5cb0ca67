"""A recording of the whole run for rerun: rounds on the timeline, cameras with small pictures.

Points appear with the round that they came with and stay. Positions count from the memory's origin
where float32 would be too coarse in the world frame; the recording's name says so.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import rerun
from numpy.typing import NDArray
from PIL import Image

from gvtools.cameras import Cameras
from gvtools.files import replaced_when_written
from gvtools.runs.layout import RECORD
from gvtools.runs.run import load_run
from gvtools.splats import TERMS
from pipelines.export.formats import ExportOptions
from pipelines.export.source import ExportSource

# The viewer is slow beyond it.
MAX_POINTS = 1_000_000
# Longer side of pictures [px], and their quality as JPEG.
SIDE, QUALITY = 320, 80
# How far from a camera its picture is drawn, in shares of the scene's extent.
DISTANCE = 0.03
TIMELINE = "round"
# Where float32 is coarser than this share of a voxel, positions count from the memory's origin.
ROUNDING = 0.1


# The round that a camera came with, its kind, the camera, and its picture where there is one.
Shot = tuple[int, str, Cameras, NDArray[np.uint8] | None]


def write_rrd(source: ExportSource, path: Path, options: ExportOptions) -> str:
    """Write the recording."""
    memory = source.memory
    points = source.points(options, most=MAX_POINTS)
    reach = float(np.abs(points.positions).max())
    far = reach * 2.0**-24 > ROUNDING * memory.voxel
    origin = memory.frame.origin if far else np.zeros(3)
    radii = np.maximum(memory.columns.spacing[points.rows], np.float32(points.edge)) / 2
    extent = float(np.linalg.norm(np.ptp(points.positions, axis=0)))
    name = source.path.resolve().name
    if far:
        name += f", counted from {' '.join(f'{x:.10g}' for x in origin)}"
    shots = 0
    with replaced_when_written(path, suffix=path.suffix) as temporary:
        recording = rerun.RecordingStream("gvtools")
        recording.save(temporary)
        recording.send_recording_name(name)
        if source.up is not None:
            axis = int(np.abs(source.up).argmax())
            way = "UP" if source.up[axis] > 0 else "DOWN"
            nearest = getattr(rerun.ViewCoordinates, f"RIGHT_HAND_{'XYZ'[axis]}_{way}")
            recording.log("/", nearest, static=True)
        rounds, made = memory.columns.round[points.rows], memory.generated[points.rows]
        scanned = memory.scanned[points.rows]
        sources = {"observed": ~(made | scanned), "scanned": scanned, "generated": made}
        for number in memory.rounds:
            recording.set_time(TIMELINE, sequence=int(number))
            for kind, of_kind in sources.items():
                rows = np.flatnonzero((rounds == number) & of_kind)
                if len(rows):
                    positions = points.positions[rows] - origin
                    recording.log(
                        f"memory/{kind}/round_{number:03d}",
                        rerun.Points3D(positions, colors=points.colors[rows], radii=radii[rows]),
                    )
        recording.set_time(TIMELINE, sequence=0)
        _log_fit(recording, source, origin)
        for shot in _shots(source):
            _log(recording, shot, origin=origin, distance=DISTANCE * extent)
            shots += 1
        recording.flush()
        recording.disconnect()
    return f"{source.points_summary(points)} and {shots} cameras in {path}"


def _log_fit(
    recording: rerun.RecordingStream, source: ExportSource, origin: NDArray[np.float64]
) -> None:
    """The fitted Gaussians, where this version of rerun has them."""
    if source.appearance is None or not hasattr(rerun, "GaussianSplats3D"):
        return
    splats = source.splats(ExportOptions(observed=True))
    one = replace(splats, values=splats.values[: splats.fitted])
    colors = np.concatenate([one.colors, one.opacities[:, None]], axis=1)
    # As many harmonics as degree 3 has, whatever is used.
    above = np.zeros((len(one), TERMS[-1] - 1, 3), np.float32)
    above[:, : one.harmonics.shape[1] - 1] = one.harmonics[:, 1:]
    recording.log(
        "fit",
        rerun.GaussianSplats3D(
            one.positions + (one.origin - origin),
            scales=np.exp(one.log_scales),
            quaternions=np.roll(one.quaternions, -1, axis=1),
            colors=np.rint(255 * colors).astype(np.uint8),
            sh_coefficients=above,
            spherical_harmonics_degree=one.degree,
        ),
    )


def _log(
    recording: rerun.RecordingStream, shot: Shot, *, origin: NDArray[np.float64], distance: float
) -> None:
    number, kind, camera, picture = shot
    if picture is not None:
        image = Image.fromarray(picture)
        image.thumbnail((SIDE, SIDE))
        picture = np.asarray(image)
        camera = camera.resized(picture.shape[1], picture.shape[0])
    pose = camera.world_from_cam[0]
    entity = rerun.new_entity_path(["cameras", kind, f"round_{number:03d}", camera.names[0]])
    recording.set_time(TIMELINE, sequence=number)
    recording.log(
        entity,
        rerun.Transform3D(translation=pose[:3, 3] - origin, mat3x3=pose[:3, :3]),
        rerun.Pinhole(
            image_from_camera=camera.K[0],
            resolution=[int(camera.width[0]), int(camera.height[0])],
            camera_xyz=rerun.ViewCoordinates.RDF,
            image_plane_distance=distance,
        ),
    )
    if picture is not None:
        recording.log(entity, rerun.Image(picture).compress(jpeg_quality=QUALITY))


def _shots(source: ExportSource) -> Iterator[Shot]:
    """Cameras of the memory's views and the run's targets, with pictures where they are there."""
    run = load_run(source.path) if (source.path / RECORD).is_file() else None
    for view in source.memory.views:
        name = view.camera.names[0]
        if view.scanned:
            continue
        if view.generated:
            if run is None:
                yield view.round, "generated", view.camera, None
            continue
        picture = source.project[name].load().rgb if name in source.project else None
        yield view.round, "context", view.camera, picture
    for target in run.views if run else ():
        if source.up_to is None or target.round <= source.up_to:
            yield target.round, "generated", target.camera, target.read().picture
