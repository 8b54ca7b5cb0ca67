"""Pictures of a training: context, hint, completion and truth side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gvtools.completers.geoverse.composition import compose
from gvtools.completers.geoverse.conditioning import encode_views, fill_holes
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.files import replaced_when_written
from gvtools.training.batch import TrainingBatch
from gvtools.training.encoder_stage import decode_heads, head_features

GAP = 4


@torch.no_grad()
def completion_sheet(model: GeoVerse, batch: TrainingBatch, *, seed: int = 0) -> NDArray[np.uint8]:
    """A row for each sample: its views as the model gets them, what it makes of them, the truth.

    Three bands a sample: given pictures and projections, completions (context pictures stay), true
    pictures; then the same for depth, each sample in its own range.

    Returns:
        (H, W, 3).
    """
    training = model.training
    model.eval()
    made = model.generate(batch.views, seed=seed)
    model.train(training)
    context = batch.views.context
    shown = fill_holes(batch.views, model.config.hints)
    rgb, found = compose(shown, made.decoded, made.hint)
    pictures = batch.images.clone()
    pictures[:, context:] = rgb.clamp(0, 1)
    depth = made.decoded.geometry.depth[:, :, None].float()
    depth[:, context:] = found[:, :, None]
    rows = []
    for index in range(len(batch)):
        rows += [
            _band(shown.images[index]),
            _band(pictures[index]),
            _band(batch.images[index]),
            _depth_band(shown.depth[index]),
            _depth_band(depth[index]),
            _depth_band(batch.depth[index]),
        ]
    return np.concatenate(rows)


@torch.no_grad()
def encoder_sheet(model: GeoVerse, batch: TrainingBatch) -> NDArray[np.uint8]:
    """Four bands a sample: pictures decoded from their own features, true ones, depth likewise.

    Returns:
        (H, W, 3).
    """
    levels = encode_views(model.geometry, batch.true_views, slice(None), config=model.config.hints)
    geometry, rgb = decode_heads(model, head_features(model, levels, batch), batch)
    depth = geometry.depth[:, :, None]
    rows = []
    for index in range(len(batch)):
        rows += [
            _band(rgb[index].clamp(0, 1)),
            _band(batch.images[index]),
            _depth_band(depth[index]),
            _depth_band(batch.depth[index]),
        ]
    return np.concatenate(rows)


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Written under another name, then renamed."""
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced_when_written(path) as temporary:
        Image.fromarray(image).save(temporary, format="PNG")


def _band(pictures: Tensor) -> NDArray[np.uint8]:
    """(V, 3, H, W) in [0, 1] side by side."""
    tiles = (pictures.cpu().permute(0, 2, 3, 1).numpy() * 255).round().clip(0, 255)
    return _joined(tiles.astype(np.uint8))


def _depth_band(depth: Tensor) -> NDArray[np.uint8]:
    """(V, 1, H, W) side by side; near is bright, unknown black."""
    values = depth[:, 0].cpu().numpy()
    known = values > 0
    inverse = np.where(known, 1 / np.where(known, values, 1), 0)
    top = np.percentile(inverse[known], 98) if known.any() else 1.0
    grey = np.clip(inverse / max(top, 1e-12), 0, 1) * 255
    return _joined(np.repeat(grey[..., None], 3, axis=-1).astype(np.uint8))


def _joined(tiles: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(V, H, W, 3) to (H + gap, V (W + gap), 3)."""
    padded = np.pad(tiles, ((0, 0), (0, GAP), (0, GAP), (0, 0)), constant_values=255)
    return np.concatenate(list(padded), axis=1)
