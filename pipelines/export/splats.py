"""The Gaussians of an export: those that the run fitted, and the memory's points beside them.

Fitted Gaussians show what photographs saw. Of the memory's points, generated ones are added, and
scanned ones that have no photograph's observation near them. Without a fit all points are exported.
Each point becomes a spherical Gaussian.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.splat.project_kernels import LOG_SCALE, LOGIT, QUATERNION, SH
from gvtools.appearance.turning import turned
from gvtools.cameras import Cameras, concatenate
from gvtools.errors import OptionError
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.memory.store.voxel_levels import levels_above
from pipelines.export.source import ExportOptions, Source, middle

# Standard deviation of a point's Gaussian, as a share of the distance to the next point.
SPREAD = 0.6
# Opacity of a point at confidence 0, and towards which it grows with confidence.
LEAST_OPACITY, MOST_OPACITY = 0.7, 0.99
# Confidence at which the opacity is half-way between them.
HALFWAY = 0.5
# Files hold float32. Where its rounding is more than the share ROUNDING of the size of small
# Gaussians (the quantile SMALLEST), positions are relative to the middle of the scene.
ROUNDING, SMALLEST = 0.1, 0.01


@dataclass(frozen=True, eq=False)
class Splats:
    """N Gaussians with the axes of the world frame.

    Attributes:
        values: (N, VALUES) float32, see appearance.splat.project_kernels; positions are relative
            to ``origin``.
        origin: (3,) float64, world frame, scene units; zero if float32 is precise enough.
        fitted: number of fitted ones, which come first; the others are points of the memory.
        further: number of the run's other fits, which are left out.
        rounds: (N,) int32, the round in which each was added.
    """

    values: NDArray[np.float32]
    origin: NDArray[np.float64]
    fitted: int
    further: int
    rounds: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.values)

    @property
    def positions(self) -> NDArray[np.float32]:
        """(N, 3) relative to ``origin``, scene units."""
        return self.values[:, :LOG_SCALE]

    @property
    def log_scales(self) -> NDArray[np.float32]:
        """(N, 3) natural logarithms of the standard deviations, scene units."""
        return self.values[:, LOG_SCALE:QUATERNION]

    @property
    def quaternions(self) -> NDArray[np.float32]:
        """(N, 4) w, x, y, z of length 1."""
        q = self.values[:, QUATERNION:LOGIT]
        return q / np.linalg.norm(q, axis=1, keepdims=True)

    @property
    def logits(self) -> NDArray[np.float32]:
        """(N,) opacities before the sigmoid."""
        return self.values[:, LOGIT]

    @property
    def harmonics(self) -> NDArray[np.float32]:
        """(N, H, 3) coefficients; H = 9 (degree 2) with a fit, else 1 (one colour each)."""
        sh = self.values[:, SH:].reshape(len(self), -1, 3)
        return sh if self.fitted else sh[:, :1]

    def summary(self) -> str:
        """A line of text for the user."""
        points = len(self) - self.fitted
        parts = [f"{self.fitted} fitted"] if self.fitted else []
        if points or not parts:
            parts.append(f"{points} from {'further ' if self.fitted else ''}points")
        text = f"{len(self)} Gaussians ({', '.join(parts)})"
        if self.further:
            text += f", the first of {self.further + 1} fits"
        if self.origin.any():
            text += f", counted from {' '.join(f'{x:.10g}' for x in self.origin)}"
        return text


def splats_of(source: Source, options: ExportOptions) -> Splats:
    """The Gaussians that show a run or a memory."""
    appearance, memory = source.appearance, source.memory
    if appearance is None:
        values, rounds = of_points(source, options)
        values, origin = _rounded(values, memory.frame.origin)
        return Splats(values, origin, 0, 0, rounds)
    first = appearance.gaussians
    if appearance.exposures is not None:
        from gvtools.appearance.exposed import exposed

        first = exposed(first, appearance.exposures, _photographs(memory))
    fitted = turned(first.values, first.frame.axes)
    parts, rest = [fitted], None
    of_parts = [np.zeros(len(fitted), np.int32)]
    if options.max_points is not None:
        rest = options.max_points - len(fitted)
        if rest < 0:
            raise OptionError(
                f"--max-points {options.max_points}: the run's fit has {len(fitted)} Gaussians, "
                "which are kept whole; expected no less"
            )
    further = unphotographed(memory)
    if not options.observed:
        further |= memory.generated
    if further.any() and rest != 0:
        points, came = of_points(source, ExportOptions(max_points=rest), among=further)
        points[:, :LOG_SCALE] += (memory.frame.origin - first.frame.origin).astype(np.float32)
        parts.append(points)
        of_parts.append(came)
    values, origin = _rounded(np.concatenate(parts), first.frame.origin)
    return Splats(values, origin, len(fitted), len(appearance.others), np.concatenate(of_parts))


def _rounded(
    values: NDArray[np.float32], origin: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Make positions relative to the world's origin, or to the scene's middle, see ROUNDING.

    Args:
        values: (N, VALUES), positions relative to ``origin``; is changed.
        origin: (3,) world frame.

    Returns:
        ``values``, and the (3,) origin that positions are relative to now.
    """
    positions = values[:, :LOG_SCALE].astype(np.float64) + origin
    sizes = np.exp(values[:, LOG_SCALE:QUATERNION].max(axis=1))
    reach = float(np.abs(positions).max())
    if reach * 2.0**-24 > ROUNDING * float(np.quantile(sizes, SMALLEST)):
        origin = np.round(middle(positions))
    else:
        origin = np.zeros(3)
    values[:, :LOG_SCALE] = positions - origin
    return values, origin


def unphotographed(memory: SpatialMemory) -> NDArray[np.bool_]:
    """(N,) scanned observations without a photograph's observation within their spacing."""
    scanned = memory.scanned
    seen = ~(scanned | memory.generated)
    if not scanned.any() or not seen.any():
        return scanned.copy()
    from scipy.spatial import KDTree

    positions, rows = memory.columns.positions, np.flatnonzero(scanned)
    away, _ = KDTree(positions[seen]).query(positions[rows], workers=-1)
    alone = np.zeros(len(memory), np.bool_)
    alone[rows[away > memory.columns.spacing[rows]]] = True
    return alone


def _photographs(memory: SpatialMemory) -> Cameras:
    """The cameras of the observed views."""
    return concatenate([view.camera for view in memory.views.photographed])


def of_points(
    source: Source, options: ExportOptions, *, among: NDArray[np.bool_] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Spherical Gaussians of a memory's points, one for each voxel.

    Their size follows from the distance between points, their opacity from confidence.

    Returns:
        (N, VALUES) float32 with the world's axes, positions relative to the memory's origin; and
        (N,) int32, the round of each point.
    """
    memory = source.memory
    points = source.points(options, among=among)
    columns = memory.columns
    # The next point is at least about a voxel's edge away: each voxel has one.
    above = levels_above(columns.level[points.rows], points.edge / memory.voxel)
    edges = np.ldexp(points.edge, above)
    apart = np.maximum(columns.spacing[points.rows], edges)
    local = points.positions - memory.frame.origin
    gaussians = Gaussians.at(
        local, points.colors, sizes=SPREAD * apart, frame=LocalFrame.at(memory.frame.origin)
    )
    confidence = memory.confidence[points.rows]
    share = confidence / (confidence + HALFWAY)
    opacity = LEAST_OPACITY + (MOST_OPACITY - LEAST_OPACITY) * share
    gaussians.values[:, LOGIT] = np.log(opacity / (1 - opacity))
    return gaussians.values, columns.round[points.rows].astype(np.int32)
