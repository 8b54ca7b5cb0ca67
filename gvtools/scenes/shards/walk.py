"""The views of scenes one after the other, as the files of tar shards."""

from __future__ import annotations

import io
import tarfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gvtools.errors import GvError
from gvtools.files import replaced_when_written, write_text
from gvtools.scenes.collection import SceneCollection
from gvtools.scenes.reduced import reduced
from gvtools.scenes.scene import Scene, View
from gvtools.scenes.shards.index import (
    Position,
    SceneRecord,
    ShardRecord,
    Skipped,
    ViewRecord,
    sha256_of,
)
from gvtools.scenes.shards.members import Members, encoded

_BLOCK = 512  # of a tar


@dataclass(frozen=True, eq=False)
class Step:
    """One view of a walk.

    Attributes:
        number: of its scene.
        place: of the view in its scene.
        name: of the scene.
        scene: that it belongs to.
        view: the view.
        members: its files.
    """

    number: int
    place: int
    name: str
    scene: Scene
    view: View
    members: Members


class Walk:
    """All views of a collection in order, from any position on.

    Args:
        collection: the scenes.
        max_side: pictures are reduced to it, pixels; None keeps every size.
    """

    def __init__(self, collection: SceneCollection, *, max_side: int | None) -> None:
        self.collection, self.max_side = collection, max_side
        self.position: Position = (0, 0)
        # What could not be read since ``skipped`` was taken last.
        self.skipped: list[Skipped] = []
        self._opened: tuple[int, Scene] | None = None

    def go_to(self, position: Position) -> None:
        """Go on from another view."""
        self.position = position

    def next(self) -> Step | None:
        """The next view that can be read; None at the end."""
        while self.position[0] < len(self.collection):
            number, place = self.position
            name = self.collection.names[number]
            scene = self._scene(number, name)
            if scene is None or place >= len(scene):
                self.position = (number + 1, 0)
                continue
            self.position = (number, place + 1)
            view = scene.views[place]
            try:
                members = encoded(view, view.load(), {"scene": name, "metric": scene.metric})
            except GvError as error:
                self.skipped.append(Skipped(scene=name, view=view.name, reason=str(error)))
                continue
            return Step(number, place, name, scene, view, members)
        return None

    def taken_skipped(self) -> tuple[Skipped, ...]:
        """What was skipped since the last call."""
        skipped, self.skipped = tuple(self.skipped), []
        return skipped

    def _scene(self, number: int, name: str) -> Scene | None:
        if self._opened is None or self._opened[0] != number:
            try:
                scene = reduced(self.collection.read(name), self.max_side)
            except GvError as error:
                self.skipped.append(Skipped(scene=name, reason=str(error)))
                return None
            self._opened = (number, scene)
        return self._opened[1]


def write_shard(walk: Walk, tar: Path, *, limit: float) -> ShardRecord | None:
    """Write one shard and its index from where a walk stands; None where no view is left.

    Args:
        walk: goes on by the views of the shard.
        tar: its file; the index is written beside it, after it.
        limit: bytes; the view that reaches it is the last.
    """
    first = walk.position
    step = walk.next()
    if step is None:
        return None
    views: list[ViewRecord] = []
    scenes: dict[int, SceneRecord] = {}
    with replaced_when_written(tar) as temporary:
        with tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as archive:
            while step is not None:
                views.append(_added(archive, step))
                scenes.setdefault(step.number, _scene_record(step))
                step = None if archive.offset >= limit else walk.next()
        size, checksum = temporary.stat().st_size, sha256_of(temporary)
    record = ShardRecord(
        file=tar.name,
        bytes=size,
        sha256=checksum,
        first=first,
        next=walk.position,
        scenes=tuple(scenes.values()),
        views=tuple(views),
        skipped=walk.taken_skipped(),
    )
    write_text(tar.with_suffix(".json"), record.model_dump_json() + "\n")
    return record


def _scene_record(step: Step) -> SceneRecord:
    scene = step.scene
    return SceneRecord(number=step.number, name=step.name, kind=scene.kind, metric=scene.metric)


def _added(archive: tarfile.TarFile, step: Step) -> ViewRecord:
    """Add a view's files; where each of them lies is part of the record."""
    places = {}
    for ending, content in step.members.files.items():
        # No date and no owner: equal views are equal bytes. Names of scenes and views may hold
        # signs that mean something in WebDataset's keys, so that keys are numbers.
        info = tarfile.TarInfo(f"{step.number:06d}/{step.place:06d}.{ending}")
        info.size = len(content)
        archive.addfile(info, io.BytesIO(content))
        begin = archive.offset - -(-len(content) // _BLOCK) * _BLOCK
        places[ending] = (begin, len(content), zlib.crc32(content))
    camera = step.view.camera
    values: dict[str, Any] = {
        "K": camera.K[0].tolist(),
        "cam_from_world": camera.cam_from_world[0].tolist(),
    }
    return ViewRecord(
        scene=step.number,
        view=step.place,
        name=step.view.name,
        width=int(camera.width[0]),
        height=int(camera.height[0]),
        depth_unit=step.members.depth_unit,
        members=places,
        **values,
    )
