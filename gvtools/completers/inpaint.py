"""The fast classical completer: continued planes, diffused colour, photographs where they show it.

Nothing here is learnt. Depth comes from the planes around a hole (``hole_depth``), colour from the
same surface (``hole_color``) and, where a context photograph sees the filled point, from there
(``context_color``).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64
from gvtools.completers.base import Completion, ContextView, check_views
from gvtools.completers.context_color import depth_error, look_up
from gvtools.completers.hole_color import fill_color
from gvtools.completers.hole_depth import HoleDepth, fill_depth
from gvtools.guidance import Guidance
from gvtools.options import check_range

# Weight of a reliable photograph against one neighbour, in the diffusion.
EVIDENCE_WEIGHT = 8.0
# Relative disagreement of the planes about a depth that halves its confidence.
DISAGREEMENT = 0.05


@dataclass(frozen=True)
class InpaintCompleter:
    """Fills depth from the far side of each hole's rim, and colour along the filled surface.

    Attributes:
        context_views: how many photographs to look hole points up in; 0 uses none.
        steepest_deg: a surface seen at a more grazing angle counts as a depth step.
        confidence: confidence of a generated pixel beside the rim of a small hole, in (0, 1).
        confidence_reach: distance to the rim at which it has fallen to 37 %, as a share of the
            image diagonal.
        reach: pixels farther from the rim than this share of the diagonal stay empty; None fills
            all.
        min_support: a view with fewer valid pixels is left as it is.
        sweeps: relaxation sweeps of the colour.
    """

    name: ClassVar[str] = "inpaint"

    context_views: int = 4
    steepest_deg: float = 80.0
    confidence: float = 0.5
    confidence_reach: float = 0.05
    reach: float | None = None
    min_support: int = 64
    sweeps: int = 60

    def __post_init__(self) -> None:
        # Only observed pixels have a confidence of 1.
        self._check("confidence", above=0, below=1)
        self._check("confidence_reach", above=0)
        self._check("reach", above=0)
        self._check("context_views", least=0)
        self._check("steepest_deg", above=0, below=90)
        self._check("min_support", least=1)
        self._check("sweeps", least=0)

    def _check(self, key: str, **ends: float) -> None:
        check_range(f"completer.{key}", getattr(self, key), **ends)

    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """Fill the holes of all views; see ``Completer.complete``. Nothing here is random."""
        return complete_views(context, guidance, self, self._color)

    def _color(
        self, rgb: NDArray[np.float32], known: NDArray[np.bool_], hole: Hole
    ) -> NDArray[np.float32]:
        return fill_color(rgb, known, hole.surface, evidence=hole.evidence, sweeps=self.sweeps)


@dataclass(frozen=True, eq=False)
class Hole:
    """What the colour step knows of one view.

    Attributes:
        camera: the target, a batch of one.
        surface: the filled depth.
        error: (H, W) its relative error, by estimate.
        evidence: colours (H, W, 3) from photographs and their weight (H, W).
        index: the view's row in the guidance.
    """

    camera: Cameras
    surface: HoleDepth
    error: Float64
    evidence: tuple[NDArray[np.float32], NDArray[np.float32]]
    index: int


Colorist = Callable[[NDArray[np.float32], NDArray[np.bool_], Hole], NDArray[np.float32]]


def complete_views(
    context: Sequence[ContextView], guidance: Guidance, options: InpaintCompleter, color: Colorist
) -> Completion:
    """Fill every view: depth first, then photographs, then ``color``, then confidence."""
    start = time.perf_counter()
    check_views(context, guidance)
    rgb = np.where(guidance.valid[..., None], guidance.rgb, np.float32(0))
    depth = np.where(guidance.valid, guidance.depth, np.float32(0))
    confidence = np.where(guidance.valid, np.minimum(guidance.confidence, 1), 0).astype(np.float32)
    spent = dict.fromkeys(
        ("holes", "filled", "from_context", "depth_clipped", "views_without_support"), 0.0
    )
    for index in range(len(guidance)):
        valid = guidance.valid[index]
        spent["holes"] += float((~valid).sum())
        if valid.all():
            continue
        if valid.sum() < options.min_support:
            spent["views_without_support"] += 1
            continue
        camera = guidance.cameras[index]
        focal = float(np.sqrt(camera.K[0, 0, 0] * camera.K[0, 1, 1]))
        surface = fill_depth(depth[index], valid, focal=focal, steepest_deg=options.steepest_deg)
        diagonal = float(np.hypot(*valid.shape))
        holes = ~valid & (surface.inverse > 0)
        if options.reach is not None:
            holes &= surface.distance <= options.reach * diagonal
        error = depth_error(surface.distance, surface.spread)
        fill = np.zeros_like(depth[index])
        fill[holes] = 1 / surface.inverse[holes]
        colors, weight = look_up(
            camera, fill, error, holes=holes, context=context, views=options.context_views
        )
        hole = Hole(camera, surface, error, (colors, EVIDENCE_WEIGHT * weight), index)
        colored = color(rgb[index], valid, hole)
        rgb[index][holes] = colored[holes]
        depth[index][holes] = fill[holes]
        confidence[index][holes] = _confidence(valid, surface, options)[holes]
        spent["filled"] += float(holes.sum())
        spent["from_context"] += float((weight > 0.5).sum())
        spent["depth_clipped"] += float(surface.clipped)
    spent["seconds"] = time.perf_counter() - start
    return Completion(rgb, depth, confidence, spent=spent)


def _confidence(
    valid: NDArray[np.bool_], surface: HoleDepth, options: InpaintCompleter
) -> NDArray[np.float32]:
    """(H, W): falls with the distance to the rim, the hole's extent, and disagreeing planes."""
    from scipy.ndimage import label, maximum

    length = options.confidence_reach * float(np.hypot(*valid.shape))
    labels, count = label(~valid, structure=np.ones((3, 3)))
    # A hole's extent is its inner radius: the largest distance to the rim that it holds.
    distance, hole = surface.distance[~valid], labels[~valid]
    extent = np.concatenate([[0.0], maximum(distance, hole, np.arange(1, count + 1))])[hole]
    agreement = 1 / (1 + surface.spread[~valid] / DISAGREEMENT)
    value = np.zeros(valid.shape, np.float32)
    value[~valid] = options.confidence * agreement * np.exp(-distance / length)
    value[~valid] /= np.sqrt(1 + extent / length)
    return value
