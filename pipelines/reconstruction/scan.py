"""A scan that a run's memory starts from: read, placed in the photographs' world, fused."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gvtools.errors import DegenerateError, OptionError
from gvtools.settings import Settings
from gvtools.view_selection import evenly_spread

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import FuseReport, SpatialMemory
    from gvtools.scans.placement import Placement
    from gvtools.scans.points import Scan
    from gvtools.scans.surface import Surface
    from pipelines.console import Console
    from pipelines.reconstruction.plan import Plan

# A scan is registered to recorded depth of at most so many views, and so many pixels of each.
VIEWS, PIXELS = 40, 5000


class ScanOptions(Settings):
    """An existing scan that memory starts from."""

    section = "scan"

    file: str | None = None
    """A PLY, LAS, LAZ, E57 or PCD; none starts from the photographs alone."""
    placement: str = "estimate"
    """The similarity from the scan's frame to the photographs' world: estimate, identity, a text
    file with a 3x4 or 4x4 matrix, or its numbers row by row with commas between."""
    min_fitness: float = Field(0.5, gt=0, le=1)
    """An estimated placement is refused if smaller shares of both the photographs' points and the
    scan's points have a point of the other beside them."""

    def files(self) -> tuple[Path, ...]:
        """What decides a run's result, for its fingerprint."""
        named = (self.file, self.placement)
        return tuple(Path(name) for name in named if name is not None and Path(name).is_file())


@dataclass(frozen=True, eq=False)
class PlacedScan:
    """A scan and where it lies."""

    scan: Scan
    placement: Placement

    def fuse_into(self, memory: SpatialMemory) -> tuple[FuseReport, dict[str, Any]]:
        """Fuse it into round 0; returns what became of it, and its entry in the round's report."""
        from gvtools.scans.fuse import fuse_scan

        report = fuse_scan(memory, self.scan, self.placement)
        scan = self.scan
        return report, {
            "file": scan.name,
            "points": scan.count,
            "fused": report.points,
            "stations": len(scan.stations),
            "colored_by": scan.colored_by,
            "dropped": dict(Counter(scan.dropped) + Counter(report.dropped)),
            "placement": self.placement.to_json(),
        }


def check_scan(options: ScanOptions) -> None:
    """Refuse a scan that cannot be read or placed before anything is computed."""
    from gvtools.scans.placement import given_placement
    from gvtools.scans.read import open_scan

    if options.file is None:
        if options.placement != "estimate":
            raise OptionError("scan.placement without a scan; expected --cloud FILE beside it")
        return
    open_scan(Path(options.file))
    given_placement(options.placement)


def placed_scan(plan: Plan, console: Console) -> PlacedScan | None:
    """The run's scan, placed with the plan's cameras; None where there is none."""
    from gvtools.scans.placement import given_placement
    from gvtools.scans.read import read_scan
    from gvtools.scans.registration import register

    options = plan.config.scan
    if options.file is None:
        return None
    scan = read_scan(Path(options.file))
    console.line(_told(scan))
    placement = given_placement(options.placement)
    if placement is None:
        try:
            placement = register(
                _surface(scan), photographed(plan), least=options.min_fitness,
                metric=plan.scene.metric, seed=plan.config.seed,
            )  # fmt: skip
        except DegenerateError as error:
            raise DegenerateError(f"{options.file}: {error} (--cloud-placement)") from None
    console.line(f"{scan.name}: placement {placement.summary()}")
    _check_reach(scan, placement, plan)
    return PlacedScan(scan, placement)


def _check_reach(scan: Scan, placement: Placement, plan: Plan) -> None:
    """Refuse a scan that the memory cannot hold."""
    from gvtools.memory.store.voxel_index import MAX_VOXEL
    from pipelines.reconstruction.voxel_edge import grid_frame

    assert plan.config.voxel is not None
    reach = MAX_VOXEL * plan.config.voxel
    frame = grid_frame(plan.scene, plan.context)
    away = np.abs(frame.from_world(placement.apply(scan.positions + scan.origin))).max(axis=1)
    if away.min() > reach:
        raise DegenerateError(
            f"{scan.name}: all of its {len(scan):,} points lie beyond the {reach:.3g} scene units "
            f"that voxels of {plan.config.voxel:g} reach from the cameras; expected a scan around "
            "them; correct its placement (--cloud-placement)"
        )


def _told(scan: Scan) -> str:
    text = f"{scan.name}: {len(scan):,} of {scan.count:,} scanned points"
    if len(scan.stations) > 1:
        text += f" from {len(scan.stations)} stations"
    if scan.colored_by != "colour":
        text += f", grey by {scan.colored_by}"
    dropped = ", ".join(f"{count:,} {reason}" for reason, count in scan.dropped.items())
    return f"{text} ({dropped})" if dropped else text


def _surface(scan: Scan) -> Surface:
    from gvtools.scans.surface import Surface

    centers = [station.center for station in scan.stations]
    if any(center is None for center in centers):
        return Surface(scan.positions + scan.origin)
    return Surface(scan.positions + scan.origin, np.array(centers)[scan.station])


def photographed(plan: Plan) -> Surface:
    """What the context is known to show: recorded depth, else the project's sparse points."""
    from gvtools.scans.surface import Surface

    scene, positions, seen_from = plan.scene, list[NDArray[Any]](), list[NDArray[Any]]()
    rng = np.random.default_rng(plan.config.seed)
    for name in evenly_spread([n for n in plan.context if scene[n].has_depth], VIEWS):
        view = scene[name]
        frame = view.load()
        if frame.depth is None:
            continue
        usable = frame.depth > 0 if frame.mask is None else (frame.depth > 0) & frame.mask
        row, column = np.nonzero(usable)
        picked = rng.permutation(len(row))[:PIXELS]
        row, column = row[picked], column[picked]
        pixels = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], axis=1)
        rays = pixels @ np.linalg.inv(view.camera.K[0]).T
        pose = view.camera.world_from_cam[0]
        positions.append((rays * frame.depth[row, column, None]) @ pose[:3, :3].T + pose[:3, 3])
        seen_from.append(np.broadcast_to(pose[:3, 3], positions[-1].shape))
    if positions:
        return Surface(np.concatenate(positions), np.concatenate(seen_from))
    points = scene.points
    if points is None:
        raise DegenerateError("no recorded depth and no sparse points to place it by; give it")
    centers = scene.cameras.centers
    seen = np.full(points.positions.shape, np.nan)
    seen[points.point_index] = centers[points.view_index]
    known = np.isfinite(seen).all(axis=1)
    return Surface(points.positions[known], seen[known])


def scan_line(entry: Mapping[str, Any]) -> str:
    """What a report says of a run's scan, for the user."""
    placed = entry["placement"]
    text = (
        f"{entry['file']}: {entry['fused']:,} of {entry['points']:,} points scanned from "
        f"{entry['stations']} station(s), placement {placed['how']}, scale {placed['scale']:.6g}"
    )
    return text if placed["fitness"] is None else f"{text}, fitness {placed['fitness']:.2f}"
