"""A sample written to a folder, whole or not at all; most are COLMAP dense workspaces."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gvtools.cameras import Cameras
from gvtools.errors import ProjectError
from gvtools.files import folder_replaced_when_written, write_json
from gvtools.scenes.colmap_writer import write_colmap
from gvtools.scenes.images import write_depth_map

RECORD = "sample.json"


@dataclass(frozen=True)
class WrittenSample:
    """A sample in a folder, and the names of its views."""

    folder: Path
    context: tuple[str, ...]  # to reconstruct from; they leave parts unseen
    targets: tuple[str, ...]  # to predict; their own pictures, and depth if any, are the truth
    depth_truth: tuple[str, ...]  # those with a true depth map
    seed: int | None = None

    def record(self, name: str, **options: Any) -> dict[str, Any]:
        """What its folder says of it, so that it is known again."""
        facts = {key: value for key, value in asdict(self).items() if value is not None}
        return {"sample": name, **options, **{k: v for k, v in facts.items() if k != "folder"}}


@dataclass(frozen=True, eq=False)
class SampleContent:
    """What a sample consists of: V views, named as their cameras are."""

    cameras: Cameras
    images: Sequence[NDArray[np.uint8]]  # (H, W, 3) each
    # (H, W) z-depth each, scene units, 0 = none; None: no depth map.
    depths: Sequence[NDArray[np.float32] | None]
    points: NDArray[np.float64]  # (N, 3) sparse points, world frame, scene units
    colors: NDArray[np.uint8]  # (N, 3)
    # Point index (M,), view index (M,) and position (M, 2) in pixels.
    tracks: tuple[NDArray[Any], NDArray[Any], NDArray[Any]] = field(repr=False)


def is_written(folder: Path, record: dict[str, Any]) -> bool:
    """Whether the folder holds exactly the sample that the record describes."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return False
    try:
        found = json.loads((folder / RECORD).read_text())
    except (OSError, ValueError):
        found = None
    if found != json.loads(json.dumps(record)):
        what = "another sample" if found is not None else "something other than a sample"
        raise ProjectError(
            f"{folder}: holds {what}; expected a new or an empty folder; name another one or "
            "remove this one"
        )
    return True


def write_sample(folder: Path, content: SampleContent, *, record: dict[str, Any]) -> None:
    """Write images, model, depth maps and the record to a folder that is absent or empty."""
    with written_whole(folder, record) as partial:
        (partial / "images").mkdir()
        for name, image, depth in zip(
            content.cameras.names, content.images, content.depths, strict=True
        ):
            save_png(partial / "images" / name, image)
            if depth is not None:
                write_depth_map(partial / "stereo/depth_maps" / f"{name}.geometric.bin", depth)
        point_index, view_index, xy = content.tracks
        write_colmap(
            partial / "sparse" / "0",
            content.cameras,
            points=content.points,
            colors=content.colors,
            point_index=point_index,
            view_index=view_index,
            xy=xy,
        )


@contextmanager
def written_whole(folder: Path, record: dict[str, Any]) -> Iterator[Path]:
    """A folder to write a sample into, which becomes ``folder`` with its record at the end."""
    with folder_replaced_when_written(folder) as partial:
        yield partial
        write_json(partial / RECORD, record)


def save_png(path: Path, pixels: NDArray[Any]) -> None:
    """A picture, packed fast rather than tightly."""
    Image.fromarray(pixels).save(path, compress_level=3)
