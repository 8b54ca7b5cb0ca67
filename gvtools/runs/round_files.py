"""The pictures and arrays that a round leaves for each target: written and read."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import ProjectError
from gvtools.guidance import Guidance
from gvtools.runs.arrays import save_arrays
from gvtools.runs.pictures import file_stems
from viz.run_view.view import inside

if TYPE_CHECKING:
    from pipelines.reconstruction.rounds import TargetResult

# Grey levels of valid_NAME.png.
SUPPORT_OBSERVED = 255
SUPPORT_GENERATED = 128


def target_stems(names: Sequence[str]) -> tuple[str, ...]:
    """For each target a distinct part of file names: without folders, and mostly without ending."""
    stems = [str(stem).replace("/", "__") for stem in file_stems(names).values()]
    twice = {stem.lower() for stem in stems if [s.lower() for s in stems].count(stem.lower()) > 1}
    taken = {stem.lower() for stem in stems} - twice
    out = []
    for i, stem in enumerate(stems):
        candidate, number = stem, i
        while stem.lower() in twice and (candidate == stem or candidate.lower() in taken):
            candidate, number = f"{stem}_{number:04d}", number + len(stems)
        taken.add(candidate.lower())
        out.append(candidate)
    return tuple(out)


def write_target(folder: Path, stem: str, result: TargetResult) -> None:
    """Write what the completer of a target was given and what it made.

    ``guidance_NAME.png`` (holes black), ``valid_NAME.png`` (where the guidance stands on what was
    observed 255, on what was generated before 128, holes 0), ``generated_NAME.png`` (the completed
    picture), and ``depth_NAME.npz`` with the keys guidance and completion (float32 z-depth, scene
    units, 0 = none) and fused (bool). NAME is the target's stem, see target_stems.
    """
    guidance = result.guidance
    support = np.where(guidance.generated[0], SUPPORT_GENERATED, SUPPORT_OBSERVED)
    support = np.where(guidance.valid[0], support, 0).astype(np.uint8)
    write_png(folder / f"guidance_{stem}.png", to_bytes(result.guidance.rgb[0]))
    write_png(folder / f"valid_{stem}.png", support)
    write_png(folder / f"generated_{stem}.png", to_bytes(result.completion.rgb[0]))
    save_arrays(
        folder / f"depth_{stem}.npz",
        guidance=result.guidance.depth[0],
        completion=result.completion.depth[0],
        fused=result.fused,
    )


def write_after(folder: Path, stem: str, after: Guidance) -> None:
    """Write what memory shows of a target after the round, ``after_NAME.png``; holes black."""
    write_png(folder / f"after_{stem}.png", to_bytes(after.rgb[0]))


@dataclass(frozen=True, eq=False)
class TargetFiles:
    """What a round left of one target.

    Attributes:
        name: of the target.
        camera: a batch of one.
        picture: (H, W, 3) uint8, completed; holes are black.
        depth: (H, W) float32 z-depth of the picture, brought to the memory's scale, scene units,
            0 = none.
        observed: (H, W) bool, pixels that stand on observations.
        generated: (H, W) bool, pixels that a completer made, in this round or an earlier one.
    """

    name: str
    camera: Cameras
    picture: NDArray[np.uint8]
    depth: NDArray[np.float32]
    observed: NDArray[np.bool_]
    generated: NDArray[np.bool_]


def read_target(folder: Path, entry: Mapping[str, Any]) -> TargetFiles:
    """One target of a round.

    Args:
        folder: the round's, in the run's.
        entry: the target's, of the round's report.

    Raises:
        ProjectError: files of the round are absent, damaged, of an older version or outside the
            run's folder.
    """

    def own(name: str) -> Path:
        return inside(folder.parent, folder / name)

    try:
        stem, view = entry["stem"], entry["camera"]
        camera = Cameras(
            np.array(view["K"])[None],
            np.array(view["cam_from_world"])[None],
            np.array([view["width"]]),
            np.array([view["height"]]),
            (entry["name"],),
        )
        picture = read_png(own(f"generated_{stem}.png"))
        support = read_png(own(f"valid_{stem}.png"))
        with np.load(own(f"depth_{stem}.npz"), allow_pickle=False) as stored:
            depth = stored["completion"]
        scale = entry["scale"]["scale"]
    except (OSError, EOFError, BadZipFile, ValueError, KeyError, TypeError) as error:
        raise ProjectError(
            f"{folder}: the target {entry.get('name', '?')} cannot be read ({error!r}); expected a "
            "round of this version; run reconstruct again"
        ) from error
    observed = support == SUPPORT_OBSERVED
    aligned = depth * np.float32(scale) if scale is not None and scale == scale else depth
    return TargetFiles(
        str(entry["name"]), camera, picture, aligned, observed, ~observed & (depth > 0)
    )


def camera_entry(camera: Cameras) -> dict[str, Any]:
    """A camera, a batch of one, as a report holds it."""
    return {
        "K": camera.K[0].tolist(),
        "cam_from_world": camera.cam_from_world[0].tolist(),
        "width": int(camera.width[0]),
        "height": int(camera.height[0]),
    }


def to_bytes(rgb: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Colours in [0, 1] as uint8."""
    return np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8)


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """One PNG."""
    from PIL import Image

    # Photographs hold no repeats to look for, and masks runs alone: faster, and smaller.
    Image.fromarray(image).save(path, format="PNG", compress_level=1, compress_type=zlib.Z_RLE)


def read_png(path: Path) -> NDArray[np.uint8]:
    """Its pixels."""
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image)
