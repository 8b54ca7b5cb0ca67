"""Pictures and arrays that a round leaves of each target."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import ProjectError, ShapeError
from gvtools.guidance import Guidance
from gvtools.runs.digests import check_sums
from gvtools.runs.layout import (
    AFTER,
    COMPLETION,
    GUIDANCE,
    REPORT,
    VALID,
    inside,
    round_folder,
    target_depth,
    target_picture,
    target_stems,
)
from gvtools.scenes.images import UNREADABLE
from gvtools.untrusted import expect, load_arrays, open_picture, read_json

if TYPE_CHECKING:
    from gvtools.completers.base import Completion

# Grey levels of valid_NAME.png.
SUPPORT_OBSERVED = 255
SUPPORT_SCANNED = 192
SUPPORT_GENERATED = 128


def write_target(
    folder: Path,
    stem: str,
    *,
    guidance: Guidance,
    completion: Completion,
    fused: NDArray[np.bool_],
) -> None:
    """Write the guidance of a target and its completion, batches of one.

    ``guidance_STEM.png`` (holes black), ``valid_STEM.png`` (guidance from observations 255, from a
    scan's alone 192, from generated points 128, holes 0), ``generated_STEM.png`` (the completed
    picture), and ``depth_STEM.npz`` with the keys guidance and completion (float32 z-depth, scene
    units, 0 = none), fused (bool) and confidence (of the completion, float32, 0 to 1).
    """
    support = np.where(guidance.generated[0], SUPPORT_GENERATED, SUPPORT_OBSERVED)
    support = np.where(guidance.scanned[0], SUPPORT_SCANNED, support)
    support = np.where(guidance.valid[0], support, 0).astype(np.uint8)
    write_png(target_picture(folder, GUIDANCE, stem), to_bytes(guidance.rgb[0]))
    write_png(target_picture(folder, VALID, stem), support)
    write_png(target_picture(folder, COMPLETION, stem), to_bytes(completion.rgb[0]))
    # Compression would save a fifth and take longer than all else of a target.
    np.savez(
        target_depth(folder, stem), guidance=guidance.depth[0], completion=completion.depth[0],
        fused=fused, confidence=completion.confidence[0],
    )  # fmt: skip


def write_after(folder: Path, stem: str, after: Guidance) -> None:
    """Write what memory shows of a target after the round, ``after_STEM.png``; holes black."""
    write_png(target_picture(folder, AFTER, stem), to_bytes(after.rgb[0]))


@dataclass(frozen=True, eq=False)
class TargetFiles:
    """What a round left of one target."""

    name: str
    camera: Cameras
    # (H, W, 3) completed; holes are black.
    picture: NDArray[np.uint8]
    # (H, W) z-depth of the picture, brought to the memory's scale, scene units, 0 = none.
    depth: NDArray[np.float32]
    # Pixels that stand on observations, a scan's included; that a completer made in any round.
    observed: NDArray[np.bool_]
    generated: NDArray[np.bool_]
    # Of the completion, 0 to 1; None of runs that did not keep it.
    confidence: NDArray[np.float32] | None = None


def read_target(folder: Path, entry: Mapping[str, Any]) -> TargetFiles:
    """One target of a round by its entry in the round's report."""
    try:
        stem, camera = entry["stem"], entry_camera(entry)
        picture = read_picture(folder, COMPLETION, stem)
        support = read_picture(folder, VALID, stem)
        file = inside(folder.parent, target_depth(folder, stem))
        stored = load_arrays(file)
        depth, confidence = stored["completion"], stored.get("confidence")
        scale = entry["scale"]["scale"]
        scale = np.float32(1 if scale is None or scale != scale else scale)
        maps = [depth] if confidence is None else [depth, confidence]
        shapes = {support.shape, picture.shape[:2], *(array.shape for array in maps)}
        alike = shapes == {(int(camera.height[0]), int(camera.width[0]))}
        colored = picture.shape[2:] == (3,)
        expect(alike and colored, f"pictures and depth of shapes {sorted(shapes)}")
        finite = all(array.dtype.kind == "f" and np.isfinite(array).all() for array in maps)
        sound = depth.dtype == np.float32 and not (depth < 0).any() and 0 < scale < np.inf
        expect(
            finite and sound, f"depth or confidence not finite, depth negative, or scale {scale}"
        )
    except (*UNREADABLE, ShapeError) as error:
        raise ProjectError(
            f"{folder}: the target {entry.get('name', '?')} cannot be read ({error!r}); expected a "
            "round of this version; run reconstruct again"
        ) from error
    pictures = (target_picture(folder, kind, stem) for kind in (COMPLETION, VALID))
    check_sums(folder, (path.name for path in (*pictures, file)))
    observed = support >= SUPPORT_SCANNED
    aligned = depth * scale
    return TargetFiles(
        str(entry["name"]), camera, picture, aligned, observed, ~observed & (depth > 0), confidence
    )


def read_picture(folder: Path, kind: str, stem: str) -> NDArray[np.uint8]:
    """The pixels of a target's picture, see ``layout.target_picture``."""
    with open_picture(inside(folder.parent, target_picture(folder, kind, stem))) as image:
        return np.asarray(image)


def entry_camera(entry: Mapping[str, Any]) -> Cameras:
    """The camera, a batch of one, of a target's entry in a report."""
    stored = entry["camera"]
    size = stored["width"], stored["height"]
    return Cameras.alike(stored["K"], stored["cam_from_world"], size=size, names=(entry["name"],))


def completed_picture(run: Path, number: int, name: str) -> Path | None:
    """The file, absolute, with the completed picture of a target; None where there is none."""
    folder = round_folder(run, number)
    try:
        views = read_json(folder / REPORT)["views"]
        stem = str(next(view["stem"] for view in views if view["name"] == name))
    except (OSError, ValueError, KeyError, TypeError, StopIteration):
        (stem,) = target_stems((name,))
    path = target_picture(folder, COMPLETION, stem)
    return inside(run, path).resolve() if path.is_file() else None


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
    """Write a picture as PNG."""
    from PIL import Image

    # Run lengths alone are faster than a search for repeats, and smaller on these pictures.
    Image.fromarray(image).save(path, format="PNG", compress_level=1, compress_type=zlib.Z_RLE)
