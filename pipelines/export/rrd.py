"""A recording of the whole run for rerun: rounds on the timeline, cameras with small pictures.

Points appear with the round that they came with and stay. Positions count from the memory's origin
where float32 would be too coarse in the world frame; the recording's name says so.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import GvError
from gvtools.files import replaced_when_written
from gvtools.runs.layout import RECORD
from gvtools.runs.run import Run, load_run
from pipelines.export.source import ExportOptions, Source, points_summary

if TYPE_CHECKING:
    import rerun

# The viewer is slow beyond it.
MAX_POINTS = 1_000_000
# Longer side of pictures [px], and their quality as JPEG.
SIDE, QUALITY = 320, 80
# How far from a camera its picture is drawn, in shares of the scene's extent.
DISTANCE = 0.03
TIMELINE = "round"
# Where float32 is coarser than this share of a voxel, positions count from the memory's origin.
ROUNDING = 0.1


@dataclass(frozen=True, eq=False)
class Shot:
    """A camera with its picture.

    Attributes:
        round: that it came with.
        kind: ``context`` or ``generated``.
        camera: a batch of one, world frame.
        picture: (H, W, 3) uint8; None where there is none.
    """

    round: int
    kind: str
    camera: Cameras
    picture: NDArray[np.uint8] | None


def write(source: Source, path: Path, options: ExportOptions) -> str:
    """Write the recording."""
    import rerun

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
        rounds, made = memory.columns.round[points.rows], memory.generated[points.rows]
        scanned = memory.scanned[points.rows]
        sources = {"observed": ~(made | scanned), "scanned": scanned, "generated": made}
        for number in memory.rounds:
            recording.set_time(TIMELINE, sequence=int(number))
            for kind, of_kind in sources.items():
                rows = np.flatnonzero((rounds == number) & of_kind)
                if len(rows):
                    recording.log(
                        f"memory/{kind}/round_{number:03d}",
                        rerun.Points3D(
                            points.positions[rows] - origin,
                            colors=points.colors[rows],
                            radii=radii[rows],
                        ),
                    )
        for shot in _shots(source):
            _log(recording, shot, origin=origin, distance=DISTANCE * extent)
            shots += 1
        recording.flush()
        recording.disconnect()
    return f"{points_summary(points, memory)} and {shots} cameras in {path}"


def _log(
    recording: rerun.RecordingStream, shot: Shot, *, origin: NDArray[np.float64], distance: float
) -> None:
    import rerun

    camera, picture = shot.camera, shot.picture
    if picture is not None:
        picture = _reduced(picture)
        camera = camera.resized(picture.shape[1], picture.shape[0])
    pose = camera.world_from_cam[0]
    entity = rerun.new_entity_path(
        ["cameras", shot.kind, f"round_{shot.round:03d}", camera.names[0]]
    )
    recording.set_time(TIMELINE, sequence=shot.round)
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


def _shots(source: Source) -> Iterator[Shot]:
    """Cameras of the memory's views and the run's targets, with pictures where they are there."""
    run = load_run(source.path) if (source.path / RECORD).is_file() else None
    scene = _scene(run)
    for view in source.memory.views:
        name = view.camera.names[0]
        if view.scanned:
            continue
        if view.generated:
            if run is None:
                yield Shot(view.round, "generated", view.camera, None)
            continue
        picture = scene[name].load().rgb if scene is not None and name in scene.names else None
        yield Shot(view.round, "context", view.camera, picture)
    for target in run.views if run else ():
        if source.up_to is None or target.round <= source.up_to:
            yield Shot(target.round, "generated", target.camera, target.read().picture)


def _scene(run: Run | None) -> Any:
    """The run's project; None where it cannot be read any more."""
    try:
        return None if run is None else run.scenes[0]
    except GvError:
        return None


def _reduced(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The picture with sides of at most ``SIDE``."""
    from PIL import Image

    image = Image.fromarray(picture)
    image.thumbnail((SIDE, SIDE))
    return np.asarray(image)
