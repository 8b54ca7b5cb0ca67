"""One round of a run with its files and its report."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gvtools.completers.base import ContextView, create
from gvtools.completers.effort import sparing
from gvtools.depth.from_memory import MEMORY, depth_from_memory
from gvtools.depth.scale_check import disagrees, scale_to_points
from gvtools.depth.source import DepthMap
from gvtools.memory.spatial_memory import FuseReport, SpatialMemory
from gvtools.runs.round_files import camera_entry, target_stems, write_after, write_target
from gvtools.scenes.scene import Frame, View
from pipelines.console import Console
from pipelines.reconstruction import rounds
from pipelines.reconstruction.depth_cache import KeptDepth, warn_of_depth
from pipelines.reconstruction.plan import Plan
from pipelines.reconstruction.round_targets import RoundTargets

# Targets whose files are written at once.
WRITERS = 2


def run_round(
    plan: Plan,
    targets: RoundTargets,
    number: int,
    context: Sequence[ContextView],
    folder: Path,
    console: Console,
) -> dict[str, Any]:
    """Run round ``number`` (0 is the context's), write its files, and report it, JSON-ready."""
    memory, clock = targets.memory, rounds.Clock()
    start = time.perf_counter()
    voxels = memory.voxels
    about: dict[str, Any] = {"dropped": {}, "depth": [], "views": []}
    about |= {"coverage_before": None, "coverage_after": None}
    if number == 0:
        total, said = _lift_context(plan, memory, folder, clock, console)
    else:
        total, said = _complete(plan, targets, number, context, folder, clock, console)
    about |= said
    generated = int(memory.generated.sum())
    return {
        "round": number,
        "points": len(memory),
        "voxels": memory.voxels,
        "voxels_added": memory.voxels - voxels,
        "observed": len(memory) - generated,
        "generated": generated,
        "added": total.added,
        "merged": total.merged,
        "rejected": total.rejected,
        "fuse": asdict(total),
        "dropped": about["dropped"],
        "depth": about["depth"],
        "coverage_before": about["coverage_before"],
        "coverage_after": about["coverage_after"],
        "seconds": {**clock.seconds, "total": time.perf_counter() - start},
        "bytes": memory.nbytes,
        "views": about["views"],
    }


def _lift_context(
    plan: Plan,
    memory: SpatialMemory,
    folder: Path,
    clock: rounds.Clock,
    console: Console,
) -> tuple[FuseReport, dict[str, Any]]:
    least = plan.config.savings.depth_from_memory

    def known(view: View, frame: Frame) -> DepthMap | None:
        if least is None:
            return None
        splat = plan.config.splat
        found = depth_from_memory(memory, view.camera, frame.rgb, least=least, options=splat)
        # What a view before it got wrong must not spread.
        fit = found and scale_to_points(plan.scene, view.name, found.depth)
        return None if fit and disagrees(fit) else found

    source = KeptDepth(plan.scene, plan.context, plan.source, folder, unfinished=True, known=known)
    if source.kept:
        console.line(
            f"taking over the depth of {source.kept} of {len(plan.context)} context views, "
            "which an interrupted attempt at this run had computed"
        )
    total, dropped, depth = rounds.observe_context(
        plan.scene, plan.context, source=source,
        memory=memory, config=plan.config, clock=clock, progress=console.track,
    )  # fmt: skip
    warn_of_depth(depth, console)
    spared = sum(report["source"] == MEMORY for report in depth)
    if spared:
        console.line(
            f"memory explains {spared} of {len(depth)} context views: their depth was not computed"
        )
    return total, {"dropped": dropped, "depth": depth}


def _complete(
    plan: Plan,
    followed: RoundTargets,
    number: int,
    context: Sequence[ContextView],
    folder: Path,
    clock: rounds.Clock,
    console: Console,
) -> tuple[FuseReport, dict[str, Any]]:
    config, memory, rows = plan.config, followed.memory, plan.schedule[number - 1]
    cameras = plan.targets.cameras[list(rows)]
    all_stems = target_stems(plan.targets.cameras.names)
    stems = [all_stems[row] for row in rows]
    with clock.stage("project"):
        targets = followed.of(number)
        known = [target.guidance() for target in targets]
    followed.look_ahead(number + 1)
    # Files are compressed beside the work on the next targets.
    with ThreadPoolExecutor(WRITERS) as pool:
        writing: list[Future[None]] = []
        results, total = rounds.complete_targets(
            targets, number, memory=memory,
            completer=sparing(
                create(config.completer, **config.completer_options),
                config.savings.minor_holes,
                one_step=config.savings.one_step,
                half_size=config.savings.half_size,
                no_prior=config.savings.no_prior,
                near_holes=config.savings.near_holes,
            ),
            context=context, config=config, clock=clock, progress=console.track,
            done=lambda at, result: writing.append(
                pool.submit(write_target, folder, stems[at], result)
            ),
        )  # fmt: skip
        with clock.stage("project"):
            grown = [target.guidance() for target in targets]
        for stem, guidance in zip(stems, grown, strict=True):
            writing.append(pool.submit(write_after, folder, stem, guidance))
        for written in writing:
            written.result()
    views = [
        {
            **result.report,
            "stem": stem,
            "camera": camera_entry(camera),
            "coverage": before.coverage,
            "coverage_after": after.coverage,
        }
        for stem, camera, result, before, after in zip(
            stems, cameras, results, known, grown, strict=True
        )
    ]
    refused = [view for view in views if view["scale"]["status"] != "aligned"]
    if refused:
        console.warn(
            f"round {number}: {len(refused)} of {len(results)} completions give no points, first "
            f"{refused[0]['name']}: {refused[0]['scale']['status']}"
        )
    return total, {
        "coverage_before": _mean([guidance.coverage for guidance in known]),
        "coverage_after": _mean([guidance.coverage for guidance in grown]),
        "views": views,
    }


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None
