"""One round of a run with its files and its report."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from gvtools.completers.base import ContextView
from gvtools.depth.from_memory import MEMORY, depth_from_memory
from gvtools.depth.scale_check import disagrees, scale_to_points
from gvtools.depth.source import DepthMap
from gvtools.memory.spatial_memory import FuseReport, SpatialMemory
from gvtools.runs.layout import target_stems
from gvtools.runs.target_files import camera_entry, write_after, write_target
from gvtools.scenes.scene import Frame, View
from pipelines.console import Console
from pipelines.reconstruction import rounds
from pipelines.reconstruction.depth_cache import DepthCache, warn_of_depth
from pipelines.reconstruction.plan import Plan
from pipelines.reconstruction.round_targets import RoundTargets
from pipelines.reconstruction.scan import scan_line

# Targets whose files are written at once.
WRITERS = 2


def run_round(
    plan: Plan,
    targets: RoundTargets,
    number: int,
    *,
    context: Sequence[ContextView],
    folder: Path,
    console: Console,
) -> dict[str, Any]:
    """Run round ``number``, write its files into ``folder``, and return its report, JSON-ready.

    Round 0 fuses the context views; later rounds complete and fuse their targets. In the report,
    ``points``, ``observed`` (by cameras), ``scanned`` and ``generated`` count observations in the
    memory after the round; ``scan`` tells of the scan that it starts from;
    ``added``, ``merged`` and ``rejected`` are those of FuseReport; ``coverage_*`` are mean shares
    of target pixels (0 to 1) that the memory projects to, None in round 0; ``bytes`` is its size.
    """
    memory, clock = targets.memory, rounds.Clock()
    start = time.perf_counter()
    voxels = memory.voxels
    report: dict[str, Any] = {"dropped": {}, "depth": [], "views": [], "scan": None}
    report |= {"coverage_before": None, "coverage_after": None}
    if number == 0:
        total, entries = _lift_context(plan, memory, folder, clock=clock, console=console)
    else:
        total, entries = _complete(
            plan, targets, number, context=context, folder=folder, clock=clock, console=console
        )
    report |= entries
    generated, scanned = memory.generated_count, memory.scanned_count
    return {
        "round": number,
        "points": len(memory),
        "voxels": memory.voxels,
        "voxels_added": memory.voxels - voxels,
        "observed": len(memory) - generated - scanned,
        "scanned": scanned,
        "generated": generated,
        "added": total.added,
        "merged": total.merged,
        "rejected": total.rejected,
        "fuse": asdict(total),
        "dropped": report["dropped"],
        "depth": report["depth"],
        "scan": report["scan"],
        "coverage_before": report["coverage_before"],
        "coverage_after": report["coverage_after"],
        "seconds": {**clock.seconds, "total": time.perf_counter() - start},
        "bytes": memory.nbytes,
        "views": report["views"],
    }


def _lift_context(
    plan: Plan,
    memory: SpatialMemory,
    folder: Path,
    *,
    clock: rounds.Clock,
    console: Console,
) -> tuple[FuseReport, dict[str, Any]]:
    """Round 0: fuse the scan, then the context views with recorded, projected or computed depth.

    A view whose depth would have to be computed takes the memory's projected depth if that matches
    its photograph on a share ``savings.depth_from_memory`` of its pixels.
    """
    least = plan.config.savings.depth_from_memory

    scene = plan.evidence or plan.scene

    def from_memory(view: View, frame: Frame) -> DepthMap | None:
        if least is None or plan.evidence is not None:
            return None
        splat = plan.config.splat
        depth_map = depth_from_memory(memory, view.camera, frame.rgb, least=least, options=splat)
        # Reject projected depth that contradicts the sparse points: errors would accumulate.
        fit = depth_map and scale_to_points(scene, view.name, depth_map.depth)
        return None if fit and disagrees(fit) else depth_map

    source = DepthCache(
        scene, plan.context, plan.source, folder=folder, unfinished=True, fallback=from_memory
    )
    if source.kept:
        console.line(
            f"taking over the depth of {source.kept} of {len(plan.context)} context views, "
            "which an interrupted attempt at this run had computed"
        )
    scanned, scan = FuseReport(), None
    if plan.scan is not None:
        with clock.stage("fuse"):
            scanned, scan = plan.scan.fuse_into(memory)
        console.line(scan_line(scan))
    total, dropped, depth = rounds.observe_context(
        scene, plan.context, source=source,
        memory=memory, config=plan.config, clock=clock, progress=console.track,
    )  # fmt: skip
    warn_of_depth(depth, console)
    skipped = sum(report["source"] == MEMORY for report in depth)
    if skipped:
        console.line(
            f"{skipped} of {len(depth)} context views took their depth from the memory, which "
            "matches their photographs"
        )
    return replace(scanned, dropped={}) + total, {"dropped": dropped, "depth": depth, "scan": scan}


def _complete(
    plan: Plan,
    round_targets: RoundTargets,
    number: int,
    *,
    context: Sequence[ContextView],
    folder: Path,
    clock: rounds.Clock,
    console: Console,
) -> tuple[FuseReport, dict[str, Any]]:
    config, memory, rows = plan.config, round_targets.memory, plan.schedule[number - 1]
    cameras = plan.targets.cameras[list(rows)]
    all_stems = target_stems(plan.targets.cameras.names)
    stems = [all_stems[row] for row in rows]
    with clock.stage("project"):
        targets = round_targets.of(number)
        before = [target.guidance() for target in targets]
    round_targets.prefetch_round(number + 1)
    # Compress and write files in the background while the next targets are completed.
    with ThreadPoolExecutor(WRITERS) as pool:
        writing: list[Future[None]] = []
        results, total = rounds.complete_targets(
            targets, number, memory=memory,
            completer=plan.completer,
            context=context, config=config, clock=clock, progress=console.track,
            done=lambda at, result: writing.append(
                pool.submit(
                    write_target,
                    folder,
                    stems[at],
                    guidance=result.guidance,
                    completion=result.completion,
                    fused=result.fused,
                )
            ),
        )  # fmt: skip
        with clock.stage("project"):
            after = [target.guidance() for target in targets]
        for stem, guidance in zip(stems, after, strict=True):
            writing.append(pool.submit(write_after, folder, stem, guidance))
        for written in writing:
            written.result()
    views = [
        {
            **result.report,
            "stem": stem,
            "camera": camera_entry(camera),
            "coverage": first.coverage,
            "coverage_after": last.coverage,
        }
        for stem, camera, result, first, last in zip(
            stems, cameras, results, before, after, strict=True
        )
    ]
    _warn_of_refused(number, views, console)
    return total, {
        "coverage_before": _mean([guidance.coverage for guidance in before]),
        "coverage_after": _mean([guidance.coverage for guidance in after]),
        "views": views,
    }


def _warn_of_refused(number: int, views: Sequence[dict[str, Any]], console: Console) -> None:
    refused = [view for view in views if not view["scale"]["accepted"]]
    if refused:
        console.warn(
            f"round {number}: {len(refused)} of {len(views)} completions give no points, first "
            f"{refused[0]['name']}: {refused[0]['scale']['description']}"
        )


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None
