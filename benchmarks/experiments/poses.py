"""Cameras that the ray head gives back, and how much of that is in the pictures.

The encoder is told the cameras where a model's configuration says so (``hints.cameras``). Grey
pictures and those of another scene then show what comes from being told alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.experiments.cases import SIZE
from benchmarks.experiments.options import ExperimentOptions
from benchmarks.experiments.rows import geoverse
from gvtools.completers.geoverse.conditioning import encode_views
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.evaluation.tables import Column, Table
from gvtools.networks.depth_anything.geometry_head import ViewGeometry
from gvtools.networks.depth_anything.rays import poses_least_squares
from gvtools.training.samples import TrainingBatch, collate
from gvtools.training.small_model_stages import scene_unit
from gvtools.training.views import ContextChoice, ProceduralViews

READS = ("weights", "scenes", "size", "seed")


def run(options: ExperimentOptions) -> tuple[dict[str, Any], list[Table]]:
    """Figures and a table; see ``READS``."""
    side = options.size or SIZE
    model = geoverse(options.weights).model  # type: ignore[attr-defined]
    data = ProceduralViews(
        seed=options.seed,
        split="held-out",
        size=(side, side),
        context=ContextChoice(most=model.config.context),
        fill=model.config.hints.fill,
    )
    device = next(model.parameters()).device
    told = "cameras told" if model.config.hints.cameras else "no cameras told"
    other: list[Tensor] = []
    sources: dict[str, Callable[[GeoVerse, TrainingBatch], ViewGeometry]] = {
        f"true pictures, {told}": lambda model, batch: _of_pictures(model, batch, batch.images),
        f"generated pictures, {told}": lambda model, batch: (
            model.generate(batch.views, seed=options.seed).decoded.geometry
        ),
        f"pictures of another scene, {told}": lambda model, batch: _of_pictures(
            model, batch, other[0]
        ),
        f"grey pictures, {told}": lambda model, batch: _of_pictures(
            model, batch, torch.full_like(batch.images, 0.5)
        ),
    }
    if model.config.hints.cameras:
        sources["true pictures, no cameras told"] = lambda model, batch: _of_pictures(
            model, batch, batch.images, cameras=False
        )
    errors: dict[str, list[Tensor]] = {name: [] for name in sources}
    for index in range(options.scenes):
        batch = collate([data.sample(index)]).to(device)
        other[:] = [data.sample(index + options.scenes).images[None].to(device)]
        for name, source in sources.items():
            errors[name].append(_errors(source(model, batch), batch))
    found: dict[str, Any] = {"scenes": options.scenes, "seed": options.seed}
    rows: list[tuple[Any, ...]] = []
    for name, entries in errors.items():
        rotation, centre, zero, constant = torch.cat(entries).numpy().T
        figures = {
            "rotation_deg_median": float(np.median(rotation)),
            "centre_mean": float(centre.mean()),
            "centre_if_first_view": float(zero.mean()),
            "centre_if_mean_of_truth": float(constant.mean()),
            "gain_over_first_view": float(zero.mean() / centre.mean()),
            "gain_over_mean_of_truth": float(constant.mean() / centre.mean()),
        }
        found[name] = figures
        rows.append((name, *figures.values()))
    columns = (
        Column("rays of"),
        Column("rotation error", "deg, median", "lower", 2),
        Column("centre error", "mean depths", "lower", 4),
        Column("of the first view's place", "mean depths", None, 4),
        Column("of the true centres' mean", "mean depths", None, 4),
        Column("gain", "x", "higher", 1),
        Column("gain over the mean", "x", "higher", 1),
    )
    return found, [
        Table(columns, tuple(rows), f"Poses from rays, {options.scenes} held-out scenes")
    ]


@torch.no_grad()
def _of_pictures(
    model: GeoVerse, batch: TrainingBatch, pictures: Tensor, *, cameras: bool = True
) -> ViewGeometry:
    """Geometry of the features of pictures (1, V, 3, H, W); ``cameras`` False tells none."""
    grid = model.geometry.encoder.grid(*batch.views.size)
    views = replace(batch.true_views, images=pictures)
    hints = model.config.hints
    if not cameras:
        hints = replace(hints, cameras=False)
    levels = encode_views(model.geometry, views, slice(None), config=hints)
    return model.geometry.geometry(
        [*levels, *model.geometry.encoder.propagate(levels[1], grid)], grid
    )


def _errors(geometry: ViewGeometry, batch: TrainingBatch) -> Tensor:
    """(V - 1, 4): degrees, and centre errors of the rays, the first view's place, the mean place.

    Lengths are in mean context depths. The first view is the reference and is left out.
    """
    poses = poses_least_squares(
        geometry.ray.float(), geometry.ray_confidence.float(), size=batch.views.size
    ).world_from_cam[0]
    cameras = batch.views.cam_from_world[0].double().cpu()
    true = torch.linalg.inv(cameras @ torch.linalg.inv(cameras[:1]))
    centres = true[:, :3, 3] / scene_unit(batch).double().cpu()
    turn = poses[:, :3, :3].mT @ true[:, :3, :3]
    cosine = (turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    columns = (
        torch.rad2deg(torch.arccos(cosine.clamp(-1, 1))),
        torch.linalg.norm(poses[:, :3, 3] - centres, dim=-1),
        torch.linalg.norm(centres, dim=-1),
        torch.linalg.norm(centres - centres.mean(0), dim=-1),
    )
    return torch.stack(columns, dim=-1)[1:]
