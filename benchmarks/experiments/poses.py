"""Cameras that the ray head gives back, and how much of that is in the pictures.

The encoder is told the cameras where a model's configuration says so (``hints.cameras``). Grey
pictures and those of another scene then show what comes from being told alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.experiments.cases import SIZE
from benchmarks.experiments.options import ExperimentOptions
from benchmarks.experiments.rows import geoverse
from gvtools.completers.geoverse.conditioning import encode_views
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.errors import DegenerateError
from gvtools.evaluation.tables import Column, Table
from gvtools.networks.depth_anything.geometry_head import ViewGeometry, camera_centres, rigid
from gvtools.training.samples import TrainingBatch, collate
from gvtools.training.small_model_stages import scene_unit
from gvtools.training.views import ContextChoice, ProceduralViews

READS = ("weights", "scenes", "size", "seed")


# Share of the largest singular value below which the rays of a view do not span three directions.
RANK = 1e-9


@dataclass(frozen=True, eq=False)
class RayCameras:
    """Cameras read from ray maps, float64 on the CPU."""

    world_from_cam: Tensor  # (..., V, 4, 4) rigid, in the rays' frame and units
    K: Tensor  # (..., V, 3, 3), pixels


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


@torch.no_grad()
def poses_least_squares(
    ray: Tensor,  # (..., V, h, w, 6); the first view is the reference
    confidence: Tensor | None = None,  # (..., V, h, w) > 0, the weights w; None for equal ones
    *,
    size: tuple[int, int],  # (H, W) of the images that K is for, pixels
    subsample: int = 4,  # step between cells
    # Where in a cell its ray passes: 0 is published, 0.5 gives K in this project's convention (the
    # first pixel's centre at 0.5). Poses are the same.
    cell_offset: float = 0.0,
) -> RayCameras:
    """Poses by a linear fit of each view's directions, as Geometric Latent Diffusion takes them.

    H of every view minimises Σ (w |H (x, y, 1)ᵀ - direction|)² over every ``subsample``-th cell;
    K is H⁻¹ of the first view, R the rotation nearest to H_v K, the centre the weighted mean of all
    origins. Rays with noise leave small numbers in K's lower triangle; they stay.
    """
    height, width = ray.shape[-3:-1]
    ray, weight = _precise(ray, confidence)
    centre = camera_centres(ray, weight)
    y, x = torch.meshgrid(
        torch.arange(0, height, subsample, dtype=ray.dtype) + cell_offset,
        torch.arange(0, width, subsample, dtype=ray.dtype) + cell_offset,
        indexing="ij",
    )
    cell = torch.stack((x, y, torch.ones_like(x)), dim=-1).flatten(0, 1)
    weight = weight[..., ::subsample, ::subsample].flatten(-2)[..., None]
    direction = ray[..., ::subsample, ::subsample, :3].flatten(-3, -2)
    left, right = weight * cell, weight * direction
    _check_rank(left, "cells with weight")
    H = torch.linalg.lstsq(left, right).solution.mT
    _check_rank(H, "directions")
    K = torch.linalg.inv(H[..., :1, :, :])
    rotation = nearest_rotation(H @ K)
    K = K / K[..., 2:, 2:]
    K = torch.tensor([size[1] / width, size[0] / height, 1], dtype=K.dtype)[:, None] * K
    return RayCameras(rigid(rotation, centre), K.expand_as(H))


def nearest_rotation(matrix: Tensor) -> Tensor:
    """The rotation nearest to each (..., 3, 3) matrix in the Frobenius norm."""
    u, _, vh = torch.linalg.svd(matrix)
    sign = torch.linalg.det(u @ vh).sign()
    return torch.cat((u[..., :2], u[..., 2:] * sign[..., None, None]), dim=-1) @ vh


def _check_rank(rows: Tensor, what: str) -> None:
    spread = torch.linalg.svdvals(rows)
    if not bool((spread[..., 2] > RANK * spread[..., 0]).all()):
        raise DegenerateError(f"{what} of a view do not span three dimensions; no pose follows")


def _precise(ray: Tensor, confidence: Tensor | None) -> tuple[Tensor, Tensor]:
    """Rays and weights, float64 on the CPU: the fits are small and want the digits."""
    ray = ray.detach().to("cpu", torch.float64)
    if not bool(torch.isfinite(ray).all()):
        raise DegenerateError("the ray map holds NaN or infinity; no pose follows")
    if confidence is None:
        return ray, torch.ones_like(ray[..., 0])
    return ray, confidence.detach().to("cpu", torch.float64)
