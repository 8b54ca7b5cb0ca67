"""One round: lift the context, or project, complete, align and fuse the round's targets."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.projection_cache import CachedProjection
from gvtools.cameras import Cameras
from gvtools.completers.base import (
    Completer,
    Completion,
    ContextView,
    run_completer,
)
from gvtools.completers.scale_alignment import ScaleAlignment
from gvtools.depth.source import DepthMap
from gvtools.errors import ProjectError
from gvtools.guidance import Guidance, concatenate
from gvtools.memory.spatial_memory import FuseReport, SpatialMemory
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.similarity import align_depth_scale
from pipelines.reconstruction.depth_cache import DepthCache, depth_report
from pipelines.reconstruction.prefetch import prefetch
from pipelines.reconstruction.settings import RunSettings

STAGES = ("depth", "fuse", "project", "complete", "align")


@dataclass
class Clock:
    """Seconds spent in each stage."""

    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the block's time to stage ``name``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] += time.perf_counter() - start


@dataclass(frozen=True, eq=False)
class TargetResult:
    """One completed target.

    Attributes:
        guidance: what the completer was given, a batch of one; a completer that takes one target
            at a time is given what earlier targets of the round added, too.
        completion: what the completer made of it, a batch of one.
        fused: which pixels went to fusion.
        report: figures of the view for the round's report.
    """

    guidance: Guidance
    completion: Completion
    fused: NDArray[np.bool_]
    report: dict[str, Any]


def observe_context(
    scene: Scene,
    names: Sequence[str],
    *,
    source: DepthCache,
    memory: SpatialMemory,
    config: RunSettings,
    clock: Clock,
    progress: Any,
) -> tuple[FuseReport, dict[str, int], list[dict[str, Any]]]:
    """Round 0: lift the context views and fuse them.

    Returns:
        The sum of what was fused, the pixels dropped by reason, and a report of each view's depth.
    """
    total = FuseReport()
    dropped: dict[str, int] = {}
    reports = []
    guesses: list[tuple[Cameras, NDArray[np.uint8], DepthMap, NDArray[np.bool_]]] = []

    def observe(*images: Any, **how: Any) -> FuseReport:
        with clock.stage("fuse"):
            return memory.observe(
                *images, round=0, options=config.back_projection,
                pixel_binning=config.savings.pixel_binning, **how,
            )  # fmt: skip

    covered = [view for view in map(scene.__getitem__, names) if source.covers(view)]
    frames = prefetch(_load, covered)
    for name in progress(names, "context views"):
        view = scene[name]
        if not source.covers(view):
            dropped["views without depth"] = dropped.get("views without depth", 0) + 1
            continue
        with clock.stage("depth"):
            frame = next(frames)
            depth_map = source.depth(view, frame)
            reports.append(depth_report(scene, name, depth_map))
            if depth_map.contradicted:
                reason = "depth that other views look through"
                dropped[reason] = dropped.get(reason, 0) + depth_map.contradicted
                # Lifting counts them as well, as pixels without depth.
                dropped["no depth"] = dropped.get("no depth", 0) - depth_map.contradicted
        guessed = depth_map.guessed
        use = frame.mask
        if guessed is not None:
            everywhere = np.ones_like(guessed) if use is None else use
            guesses.append((view.camera, frame.rgb, depth_map, guessed & everywhere))
            use = everywhere & ~guessed
            # These are fused below, not left out.
            dropped["masked"] = dropped.get("masked", 0) - int((guessed & everywhere).sum())
        report = observe(
            frame.rgb, depth_map.depth, view.camera, confidence=depth_map.confidence, mask=use
        )
        total += report
        for reason, count in report.dropped.items():
            dropped[reason] = dropped.get(reason, 0) + count
    # Last, so that they stay out of space that any view saw to be free.
    for camera, rgb, depth_map, where in guesses:
        total += observe(
            rgb,
            depth_map.depth,
            camera,
            confidence=depth_map.confidence,
            mask=where,
            generated=True,
        )
    for entry in reports:
        entry["failed"] = source.failed.get(entry["view"])
    if not len(memory) and source.failed:
        raise ProjectError(next(iter(source.failed.values())))
    if not len(memory) and total.out_of_reach:
        raise ProjectError(
            f"{scene.root}: all {total.out_of_reach} points of the context lie beyond the "
            f"{memory.reach:.3g} scene units that voxels of {memory.voxel:g} reach from the "
            "cameras; expected a greater voxel edge; leave --voxel out, or look at the depth's unit"
        )
    if not len(memory):
        raise ProjectError(
            f"{scene.root}: the context's depth gave no point; look at 'gvtools check' and at the "
            "depth's unit"
        )
    return total, dropped, reports


def _load(view: View) -> Frame:
    return view.load()


def load_context(scene: Scene, names: Sequence[str], source: DepthCache) -> list[ContextView]:
    """The context as completers see it."""
    out = []
    views = [scene[name] for name in names]
    for name, view, frame in zip(names, views, prefetch(_load, views), strict=True):
        depth = source.depth(view, frame) if source.covers(view) else None
        out.append(
            ContextView(
                name,
                view.camera,
                (frame.rgb / np.float32(255)).astype(np.float32),
                depth.depth if depth else None,
                depth.confidence if depth else None,
            )
        )
    return out


def complete_targets(
    targets: Sequence[CachedProjection],
    number: int,
    *,
    memory: SpatialMemory,
    completer: Completer,
    context: Sequence[ContextView],
    config: RunSettings,
    clock: Clock,
    progress: Any,
    done: Callable[[int, TargetResult], object] = lambda row, result: None,
) -> tuple[list[TargetResult], FuseReport]:
    """Rounds 1, 2, ...: complete, align and fuse the round's targets.

    A completer that takes several targets in a call (``batches_targets``) gets all of one size
    together; for any other, each view is completed on what the views before it added, so that they
    agree with each other.

    Args:
        targets: projections of ``memory`` into the round's cameras; each updates when it changes.
        number: number of the round, from 1.
        memory: generated points are fused into it.
        completer: see ``Completer``.
        context: the observed views that the completer may use.
        config: settings of the run.
        clock: receives the stages' times.
        progress: ``progress(items, label)`` iterates over ``items`` and shows a progress bar.
        done: called as ``done(row, result)`` after each target was completed and fused.

    Returns:
        One result per target, in the order given, and the sum of what was fused.
    """
    seed = config.seed + number
    results: list[TargetResult] = []
    total = FuseReport()

    def fuse_and_record(
        target: CachedProjection, guidance: Guidance, completion: Completion
    ) -> None:
        nonlocal total
        if not completion.whole:
            completion = replace(completion, rgb=target.colored(guidance, completion.rgb))
        result, report = _align_and_fuse(
            guidance, completion, number, memory=memory, config=config, clock=clock
        )
        done(len(results), result)
        results.append(result)
        total += report

    if completer.batches_targets:
        with clock.stage("project"):
            guidances = [target.guidance() for target in targets]
        with clock.stage("complete"):
            completions = _completed_together(completer, context, guidances, seed=seed)
        together = list(zip(targets, guidances, completions, strict=True))
        for target, guidance, completion in progress(together, f"round {number}"):
            fuse_and_record(target, guidance, completion)
        return results, total
    for target in progress(list(targets), f"round {number}"):
        with clock.stage("project"):
            guidance = target.guidance()
        with clock.stage("complete"):
            completion = run_completer(completer, context, guidance, seed=seed)
        fuse_and_record(target, guidance, completion)
    return results, total


def _completed_together(
    completer: Completer,
    context: Sequence[ContextView],
    guidances: Sequence[Guidance],
    *,
    seed: int,
) -> list[Completion]:
    """Complete the targets in one call per image size.

    Returns:
        One Completion (V = 1) per target, in the order of ``guidances``.
    """
    completions: dict[int, Completion] = {}
    sizes: dict[tuple[int, ...], list[int]] = {}
    for index, guidance in enumerate(guidances):
        sizes.setdefault(guidance.valid.shape[1:], []).append(index)
    for rows in sizes.values():
        of_one_size = concatenate([guidances[index] for index in rows])
        completion = run_completer(completer, context, of_one_size, seed=seed)
        for place, index in enumerate(rows):
            completions[index] = _row(completion, place)
    return [completions[index] for index in range(len(guidances))]


def _row(completion: Completion, index: int) -> Completion:
    rows = slice(index, index + 1)
    rays = None if completion.rays is None else completion.rays[rows]
    return Completion(
        completion.rgb[rows],
        completion.depth[rows],
        completion.confidence[rows],
        rays,
        None if completion.scale_alignment is None else completion.scale_alignment[rows],
        completion.whole,
    )


def _align_and_fuse(
    guidance: Guidance,
    completion: Completion,
    number: int,
    *,
    memory: SpatialMemory,
    config: RunSettings,
    clock: Clock,
) -> tuple[TargetResult, FuseReport]:
    valid, depth = guidance.valid[0], completion.depth[0]
    confidence = completion.confidence[0]
    with clock.stage("align"):
        alignment = _scale_alignment(guidance, completion, config)
    everywhere = completion.whole and config.fusion.pixels == "all"
    filled = depth > 0 if everywhere else ~valid & (depth > 0)
    as_observed = config.fusion.generated_as_observed
    if alignment.accepted and not as_observed:
        with clock.stage("fuse"):
            scale = np.float32(alignment.scale)
            depth = memory.behind_free_space(depth * scale, guidance.cameras, where=filled) / scale
        filled &= depth > 0
    fused = filled & (confidence >= config.fusion.min_confidence) & (confidence > 0)
    report = FuseReport()
    if not alignment.accepted:
        fused = np.zeros_like(fused)
    elif fused.any():
        with clock.stage("fuse"):
            report = memory.observe(
                np.rint(np.clip(completion.rgb[0], 0, 1) * 255).astype(np.uint8),
                (depth * np.float32(alignment.scale)).astype(np.float32),
                guidance.cameras,
                round=number,
                generated=not as_observed,
                # Confidence has to be positive everywhere; outside the mask it is not used.
                confidence=np.where(fused, confidence, np.float32(1)),
                mask=fused,
                options=config.back_projection,
                pixel_binning=config.savings.pixel_binning,
            )
    # "observed" and "completed" are shares of the target's pixels, 0 to 1.
    figures = {
        "name": guidance.cameras.names[0],
        "observed": float((valid & ~guidance.generated[0]).mean()),
        "completed": float((valid | filled).mean()),
        "fused_pixels": int(fused.sum()),
        "scale": alignment.to_json(),
        "fuse": asdict(report),
    }
    return TargetResult(guidance, completion, fused, figures), report


def _scale_alignment(
    guidance: Guidance, completion: Completion, config: RunSettings
) -> ScaleAlignment:
    """How the depth of a completion, a batch of one, gets into scene units.

    If the completer aligned its depth itself, its status is used, refusals included: its known
    pixels are copies of the memory's, so comparing them would prove nothing.
    """
    by_completer = completion.scale_alignment and completion.scale_alignment[0]
    if by_completer:
        return by_completer
    depth = completion.depth[0]
    fit = align_depth_scale(
        depth,
        guidance.depth[0],
        valid=guidance.valid[0] & (depth > 0),
        confidence=guidance.confidence[0],
        max_residual=config.fusion.max_scale_residual,
    )
    return ScaleAlignment.of_fit(fit)
