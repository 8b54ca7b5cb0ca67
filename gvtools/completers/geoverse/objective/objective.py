"""The whole training objective: five terms, their coefficients, and what each stood on.

L = l_1 L_FM^1 + l_0 L_FM^0 + l_rgb L_rgb + l_hf L_hf + l_depth L_depth
(Eq. "complete_training_loss" of the paper).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, fields
from functools import partial

import torch
from torch import Tensor

from gvtools.completers.geoverse.objective.losses import (
    depth_loss,
    depth_mask,
    flow_matching_loss,
    high_gradient_loss,
    rgb_loss,
    rgb_mask,
)
from gvtools.completers.geoverse.objective.similarity_scale import center_similarity
from gvtools.errors import OptionError
from gvtools.networks.config_json import check_range


@dataclass(frozen=True)
class LossWeights:
    """Coefficients of the terms; the paper gives none.

    Attributes:
        level1: of L_FM^1.
        level0: of L_FM^0.
        rgb: of L_rgb.
        hf: of L_hf.
        depth: of L_depth.
    """

    level1: float = 1.0
    level0: float = 1.0
    rgb: float = 1.0
    hf: float = 1.0
    depth: float = 1.0

    def __post_init__(self) -> None:
        for item in fields(self):
            check_range(f"loss weight {item.name}", getattr(self, item.name), ge=0, lt=math.inf)


@dataclass(frozen=True, eq=False)
class Prediction:
    """What the model gave; what is None has no term. V views, context first; T target views.

    Attributes:
        level1: (B, V, C, h, w) velocity.
        level0: (B, V, C, h, w) velocity.
        image: (B, T, 3, H, W).
        depth: (B, T, H, W) z-depth, model units.
        centers: (B, V, 3) camera centres, model units; ``depth`` needs them.
    """

    level1: Tensor | None = None
    level0: Tensor | None = None
    image: Tensor | None = None
    depth: Tensor | None = None
    centers: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Reference:
    """What it should have given; shapes as in ``Prediction``.

    Attributes:
        level1: velocity target.
        level0: velocity target.
        image: in the normalisation of the prediction.
        depth: scene units; not finite or not above 0 = none.
        centers: scene units.
        image_valid: (B, T, H, W) bool, None = all.
        depth_valid: (B, T, H, W) bool, None = all.
    """

    level1: Tensor | None = None
    level0: Tensor | None = None
    image: Tensor | None = None
    depth: Tensor | None = None
    centers: Tensor | None = None
    image_valid: Tensor | None = None
    depth_valid: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Objective:
    """The objective of one mini-batch.

    Attributes:
        total: (), the weighted sum.
        terms: (), each term before its coefficient, averaged over the mini-batch; a term of
            coefficient 0 is there to be logged and has no gradient.
        counts: (), what the terms stood on: ``rgb_pixels``, ``depth_pixels``; ``rgb_empty`` and
            ``depth_empty``, samples without a valid pixel; ``depth_without_scale``, samples whose
            camera centres gave no scale.
    """

    total: Tensor
    terms: dict[str, Tensor]
    counts: dict[str, Tensor]

    def record(self) -> dict[str, float]:
        """Everything as numbers for a log: ``loss``, ``loss/TERM``, ``count/NAME``."""
        values = {"loss": self.total}
        values |= {f"loss/{name}": value for name, value in self.terms.items()}
        values |= {f"count/{name}": value for name, value in self.counts.items()}
        return {name: float(value.detach()) for name, value in values.items()}


def objective(
    prediction: Prediction,
    reference: Reference,
    *,
    context: int,
    weights: LossWeights | None = None,
    context_weight: float = 0.25,
) -> Objective:
    """Every term that has a prediction, their weighted sum, and their counts.

    Args:
        prediction: see ``Prediction``.
        reference: has to hold whatever is predicted.
        context: number of context views, which come first.
        weights: None is ``LossWeights()``.
        context_weight: see ``flow_matching_loss``.
    """
    weights = weights or LossWeights()
    parts, counts = _parts(prediction, reference, context, context_weight=context_weight)
    if not parts:
        raise OptionError("objective: nothing was predicted; give at least one term")
    terms, total = {}, None
    for name, part in parts.items():
        weight = getattr(weights, name)
        with nullcontext() if weight > 0 else torch.no_grad():
            terms[name] = part().mean()
        if weight > 0:
            total = weight * terms[name] if total is None else total + weight * terms[name]
    if total is None:
        total = torch.zeros_like(next(iter(terms.values())))
    return Objective(total, terms, counts)


def _parts(
    prediction: Prediction, reference: Reference, context: int, *, context_weight: float
) -> tuple[dict[str, Callable[[], Tensor]], dict[str, Tensor]]:
    """The terms, not yet computed, and what they stand on."""
    parts: dict[str, Callable[[], Tensor]] = {}
    counts: dict[str, Tensor] = {}
    for level in ("level1", "level0"):
        if (found := getattr(prediction, level)) is not None:
            parts[level] = partial(
                flow_matching_loss,
                found,
                _wanted(reference, level),
                context=context,
                context_weight=context_weight,
            )
    if (image := prediction.image) is not None:
        wanted, valid = _wanted(reference, "image"), reference.image_valid
        parts["rgb"] = partial(rgb_loss, image, wanted, valid=valid)
        parts["hf"] = partial(high_gradient_loss, image, wanted, valid=valid)
        _count(counts, "rgb", rgb_mask(wanted, valid))
    if (depth := prediction.depth) is not None:
        wanted, valid = _wanted(reference, "depth"), reference.depth_valid
        if prediction.centers is None:
            raise OptionError("predicted depth without predicted camera centres; give both")
        similarity = center_similarity(prediction.centers, _wanted(reference, "centers"))
        parts["depth"] = partial(depth_loss, depth, wanted, similarity=similarity, valid=valid)
        _count(counts, "depth", depth_mask(wanted, valid))
        counts["depth_without_scale"] = (~similarity.ok).sum()
    return parts, counts


def _wanted(reference: Reference, name: str) -> Tensor:
    value: Tensor | None = getattr(reference, name)
    if value is None:
        raise OptionError(f"objective: {name} was predicted but the reference has none")
    return value


def _count(counts: dict[str, Tensor], name: str, mask: Tensor) -> None:
    pixels = mask.sum((1, 2, 3))
    counts[f"{name}_pixels"] = pixels.sum()
    counts[f"{name}_empty"] = (pixels == 0).sum()
