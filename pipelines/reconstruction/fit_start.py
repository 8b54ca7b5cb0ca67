"""Gaussians from a file that a fit begins with: splats or points, placed in the project."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.population import from_points
from gvtools.appearance.splat.project_kernels import VALUES
from gvtools.errors import DegenerateError
from gvtools.scans.registration import ESTIMATE, FEWEST, Surface, given_placement, register
from gvtools.splat_files import holds_splats, read_splats
from gvtools.splats import LOG_SCALE, LOGIT, QUATERNION, Splats, place_gaussians
from pipelines.reconstruction.prepare import photographed

if TYPE_CHECKING:
    from gvtools.memory.store.local_frame import LocalFrame
    from gvtools.scans.registration import Placement
    from pipelines.console import Console
    from pipelines.reconstruction.plan import Plan

# Gaussians of at least this opacity are surfaces, by which they are placed.
OPAQUE = 0.5


@dataclass(frozen=True, eq=False)
class GivenStart:
    """What a fit begins with instead of sparse points or depth."""

    gaussians: Gaussians
    fitted: bool  # whether they are Gaussians already, so that a fit goes on instead of beginning


def given_start(plan: Plan, frame: LocalFrame, console: Console) -> GivenStart | None:
    """The Gaussians of ``refine.init``; None where it names no file."""
    options = plan.config.refine
    if options.init is None:
        return None
    path = Path(options.init)
    if not holds_splats(path):
        from gvtools.scans.read import read_scan

        scan = read_scan(path)
        positions = scan.positions + scan.origin
        placement = _placed(positions, plan, console, path=path)
        local = frame.from_world(placement.apply(positions) if placement else positions)
        some = from_points(local, scan.colors, frame=frame, most=options.most_gaussians)
        console.line(f"fitting begins with {len(some):,} of {len(scan):,} points of {path}")
        return GivenStart(some, fitted=False)
    splats = read_splats(path)
    opaque = splats.opacities > OPAQUE
    surface = splats.positions[opaque if opaque.any() else slice(None)] + splats.origin
    placement = _placed(surface, plan, console, path=path)
    values = _strongest(_local(splats, placement, frame), options.most_gaussians)
    fewer = f" of {len(splats):,}" if len(values) < len(splats) else ""
    console.line(f"fitting begins with {len(values):,}{fewer} Gaussians of {path}")
    return GivenStart(Gaussians(values, frame=frame), fitted=True)


def _placed(
    positions: NDArray[np.float64], plan: Plan, console: Console, *, path: Path
) -> Placement | None:
    """Where surfaces of a file lie; None: as they are, where the project knows hardly any."""
    options = plan.config.scan
    if options.file is None and options.placement != ESTIMATE:
        return given_placement(options.placement)
    try:
        known = photographed(plan)
    except DegenerateError:
        known = None
    if known is None or len(known.positions) < FEWEST:
        console.warn(
            f"{path}: taken as it lies, since the project has fewer than {FEWEST} points to place "
            "it by; give --cloud-placement where it lies elsewhere"
        )
        return None
    try:
        placement = register(
            Surface(positions, None), known, least=options.min_fitness,
            metric=plan.scene.metric, seed=plan.config.seed,
        )  # fmt: skip
    except DegenerateError as error:
        raise DegenerateError(f"{path}: {error} (--cloud-placement)") from None
    console.line(f"{path.name}: placement {placement.summary()}")
    return placement


def _local(splats: Splats, placement: Placement | None, frame: LocalFrame) -> NDArray[np.float32]:
    """(N, VALUES) rows in a frame; harmonics above degree 2 are left out."""
    world, origin = splats.values, splats.origin
    if placement is not None:
        world, _ = place_gaussians(world, placement.world_from_scan)
        origin = placement.apply(origin[None])[0]
    local, _ = place_gaussians(world, np.block([[frame.axes.T, np.zeros((3, 1))], [0, 0, 0, 1]]))
    rows = np.zeros((len(local), VALUES), np.float32)
    count = min(VALUES, local.shape[1])
    rows[:, :count] = local[:, :count]
    rows[:, :LOG_SCALE] += frame.from_world(origin)
    return rows


def _strongest(values: NDArray[np.float32], most: int) -> NDArray[np.float32]:
    """At most so many rows: those of the most light, which is opacity times area."""
    if len(values) <= most:
        return values
    sizes = np.sort(values[:, LOG_SCALE:QUATERNION], axis=1)[:, 1:].sum(axis=1)
    light = sizes - np.log1p(np.exp(-values[:, LOGIT]))
    return values[np.sort(np.argsort(-light, kind="stable")[:most])]
