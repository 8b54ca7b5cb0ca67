"""Rounds of a run: fuse the context, then project, complete, align and fuse targets."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.appearance import Appearance, Picture
from gvtools.cameras import Cameras
from gvtools.completers.base import (
    Completer,
    Completion,
    ContextView,
    ScaleAlignment,
    run_completer,
)
from gvtools.depth.shown import MEMORY, depth_from_memory
from gvtools.depth.source import DepthMap, disagrees, scale_to_points
from gvtools.errors import ProjectError
from gvtools.guidance import Guidance, concatenate
from gvtools.kernels import parallel_kernels_may_overlap
from gvtools.memory.panoramas import Rig
from gvtools.memory.projection import Observed, Projection
from gvtools.memory.spatial_memory import FuseReport, SpatialMemory
from gvtools.memory.splat.api import ONE_PIXEL, SplatOptions
from gvtools.prefetch import prefetch
from gvtools.runs.context_depth import DepthCache, depth_report
from gvtools.runs.layout import PANORAMA, target_picture, target_stems
from gvtools.runs.target_files import (
    camera_entry,
    to_bytes,
    write_after,
    write_png,
    write_target,
)
from gvtools.scenes.scene import Frame, View
from gvtools.similarity import align_depth_scale
from pipelines.console import Console
from pipelines.reconstruction.plan import Plan, scan_line
from pipelines.reconstruction.settings import RunSettings
from pipelines.spherical_metadata import write_panorama


class CachedProjection:
    """One camera, and the memory as it is projected into it, now and after every change.

    Generated observations only fill what observed ones leave open, and never change these. So what
    the observed ones show is kept, and a projection after a completion was fused splats the
    generated ones alone. The result is that of ``SpatialMemory.project`` to the bit.

    Without ``reuse``, everything is splatted each time that the memory has changed. ``appearance``
    gives colours of what was observed.
    """

    def __init__(
        self,
        memory: SpatialMemory,
        camera: Cameras,
        *,
        options: SplatOptions | None = None,
        reuse: bool = True,
        appearance: Appearance | None = None,
    ) -> None:
        self.memory, self.camera = memory, camera
        self.options = options or SplatOptions()
        self.reuse = reuse and self.options.backend not in ONE_PIXEL
        self._at = (-1, -1)
        self._observed: Observed | None = None
        self._guidance: Guidance | None = None
        self.appearance = appearance
        self._picture: Picture | None = None

    def prefetch(self, snapshot: SpatialMemory) -> None:
        """Project what observed views show ahead of ``guidance``, where that is reused."""
        if self.reuse and self.options.backend == "cpu":
            self._observed = Projection(snapshot, self.camera, self.options).observed()
            self._at = (-1, snapshot.observed_changes)

    def guidance(self) -> Guidance:
        """The projection of the memory as it is now, a batch of one; the last one if unchanged."""
        memory = self.memory
        at = (memory.changes, memory.observed_changes)
        if self._guidance is None or at != self._at:
            if not self.reuse:
                self._guidance = memory.project(self.camera, options=self.options)
            else:
                observed = self._observed if at[1] == self._at[1] else None
                projection = Projection(memory, self.camera, self.options, observed=observed)
                self._observed = observed or projection.observed()
                self._guidance = projection.guidance()
            if self.appearance is not None:
                if self._picture is None:
                    self._picture = self.appearance.picture(self.camera)
                self._guidance = self.appearance.recolor(self._guidance, self._picture)
            self._at = at
        return self._guidance

    def colored(self, guidance: Guidance, rgb: NDArray[np.float32]) -> NDArray[np.float32]:
        """A completion's colours (1, H, W, 3), with the Gaussians' where these show a surface.

        Some photograph did see most of it, though not well enough to tell its depth. It remains
        generated: nothing observed supports it. Its depth remains the completer's.
        """
        if self._picture is None:
            return rgb
        where = ~guidance.valid[0] & self._picture.solid
        return np.where(where[..., None], self._picture.rgb, rgb[0])[None]


class RoundTargets:
    """The targets of each round as they follow the memory.

    While the targets of a round are completed, what observed views show of the next round's is
    projected in another thread, where projections are reused at all: completions do not change it.
    """

    def __init__(
        self, plan: Plan, memory: SpatialMemory, appearance: Appearance | None = None
    ) -> None:
        self.plan, self.memory, self.appearance = plan, memory, appearance
        self._pool = ThreadPoolExecutor(1)
        self._next: tuple[int, list[CachedProjection], list[Future[None]]] | None = None

    def __enter__(self) -> RoundTargets:
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def of(self, number: int) -> list[CachedProjection]:
        """The targets of round ``number``, from 1, in order."""
        if self._next is None or self._next[0] != number:
            return self._projections(number)
        _, targets, looks = self._next
        self._next = None
        for look in looks:
            look.result()
        return targets

    def prefetch_round(self, number: int) -> None:
        """Begin to project what observed views show of round ``number``, if there is one."""
        if number > len(self.plan.schedule) or not parallel_kernels_may_overlap():
            return
        if self.plan.config.fusion.generated_as_observed:
            # A snapshot holds while generated points alone are fused.
            return
        targets = self._projections(number)
        snapshot = self.memory.snapshot()
        # One by one, so that a run that is stopped need not wait for all.
        looks = [self._pool.submit(target.prefetch, snapshot) for target in targets]
        self._next = (number, targets, looks)

    def _projections(self, number: int) -> list[CachedProjection]:
        config = self.plan.config
        return [
            CachedProjection(
                self.memory,
                camera,
                options=config.splat,
                reuse=config.savings.reuse,
                appearance=self.appearance,
            )
            for camera in self.plan.targets.cameras[list(self.plan.schedule[number - 1])]
        ]


STAGES = ("depth", "fuse", "project", "complete", "align")
# Targets whose files are written at once.
WRITERS = 2


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
    """One completed target."""

    # What the completer was given, a batch of one: one that takes a target at a time is given what
    # earlier targets of the round added, too.
    guidance: Guidance
    completion: Completion  # a batch of one
    fused: NDArray[np.bool_]  # (H, W) pixels that went to fusion
    fusion: FuseReport
    figures: dict[str, Any]  # of the view, for the round's report


def fuse_context(
    plan: Plan, memory: SpatialMemory, folder: Path, *, console: Console
) -> dict[str, Any]:
    """Round 0: fuse the scan, then the context views with recorded, projected or computed depth.

    Depth that nothing confirms comes last, as generated: it stays out of space that any view saw to
    be free. Computed depth is kept in ``folder``. Returns the round's report.
    """
    clock, begun, voxels = Clock(), time.perf_counter(), memory.voxels
    scene, config = plan.evidence or plan.scene, plan.config
    cache = DepthCache(
        scene, plan.context, plan.source,
        folder=folder, unfinished=True, fallback=_depth_from_memory(plan, memory),
    )  # fmt: skip
    if cache.file_count:
        console.line(
            f"taking over the depth of {cache.file_count} of {len(plan.context)} context views, "
            "which an interrupted attempt at this run had computed"
        )
    total, scan = FuseReport(), None
    if plan.scan is not None:
        with clock.stage("fuse"):
            scanned, scan = plan.scan.fuse_into(memory)
        total = replace(scanned, dropped={})
        console.line(scan_line(scan))
    dropped: Counter[str] = Counter()
    reports: list[dict[str, Any]] = []
    guesses: list[tuple[Cameras, NDArray[np.uint8], DepthMap, NDArray[np.bool_]]] = []

    def observe(*images: Any, **how: Any) -> FuseReport:
        with clock.stage("fuse"):
            return memory.observe(
                *images, round=0, options=config.back_projection,
                pixel_binning=config.savings.pixel_binning, **how,
            )  # fmt: skip

    covered = [view for view in map(scene.__getitem__, plan.context) if cache.covers(view)]
    frames = prefetch(lambda view: view.load(), covered)
    for name in console.track(plan.context, "context views"):
        view = scene[name]
        if not cache.covers(view):
            dropped["views without depth"] += 1
            continue
        with clock.stage("depth"):
            frame = next(frames)
            depth_map = cache.depth(view, frame)
            reports.append(depth_report(scene, name, depth_map))
        if depth_map.contradicted:
            dropped["depth that other views look through"] += depth_map.contradicted
            # Lifting counts them as well, as pixels without depth.
            dropped["no depth"] -= depth_map.contradicted
        use, guessed = frame.mask, depth_map.guessed
        if guessed is not None:
            everywhere = np.ones_like(guessed) if use is None else use
            guesses.append((view.camera, frame.rgb, depth_map, guessed & everywhere))
            use = everywhere & ~guessed
            # These are fused below, not left out.
            dropped["masked"] -= int((guessed & everywhere).sum())
        fused = observe(
            frame.rgb, depth_map.depth, view.camera, confidence=depth_map.confidence, mask=use
        )
        total += fused
        for reason, count in fused.dropped.items():
            dropped[reason] += count
    for camera, rgb, depth_map, where in guesses:
        total += observe(
            rgb, depth_map.depth, camera,
            confidence=depth_map.confidence, mask=where, generated=True,
        )  # fmt: skip
    for entry in reports:
        entry["failed"] = cache.failed.get(entry["view"])
    if not len(memory):
        raise ProjectError(_nothing_fused(plan, memory, cache, beyond=total.out_of_reach))
    if failed := [report["failed"] for report in reports if report["failed"]]:
        console.warn(
            f"{len(failed)} of {len(reports)} views have no depth and give no points, first: "
            f"{failed[0]}"
        )
    projected = sum(report["source"] == MEMORY for report in reports)
    if projected:
        console.line(
            f"{projected} of {len(reports)} context views took their depth from the memory, which "
            "matches their photographs"
        )
    report = _round_report(0, memory, total, clock=clock, begun=begun, voxels=voxels)
    return report | {"dropped": dict(dropped), "depth": reports, "scan": scan}


def _depth_from_memory(
    plan: Plan, memory: SpatialMemory
) -> Callable[[View, Frame], DepthMap | None]:
    """The memory's depth of a view where it matches ``savings.depth_from_memory`` of its pixels."""
    least = plan.config.savings.depth_from_memory

    def projected(view: View, frame: Frame) -> DepthMap | None:
        if least is None or plan.evidence is not None:
            return None
        found = depth_from_memory(
            memory, view.camera, frame.rgb, least=least, options=plan.config.splat
        )
        # Reject projected depth that contradicts the sparse points: errors would accumulate.
        fit = found and scale_to_points(plan.scene, view.name, found.depth)
        return None if fit and disagrees(fit) else found

    return projected


def _nothing_fused(plan: Plan, memory: SpatialMemory, cache: DepthCache, *, beyond: int) -> str:
    if cache.failed:
        return next(iter(cache.failed.values()))
    if beyond:
        return (
            f"{plan.scene.root}: all {beyond} points of the context lie beyond the "
            f"{memory.reach:.3g} scene units that voxels of {memory.voxel:g} reach from the "
            "cameras; expected a greater voxel edge; leave --voxel out, or look at the depth's unit"
        )
    return (
        f"{plan.scene.root}: the context's depth gave no point; look at 'gvtools check' and at the "
        "depth's unit"
    )


def load_context(plan: Plan, cache: DepthCache) -> list[ContextView]:
    """The context as completers see it."""
    scene = plan.evidence or plan.scene
    views, out = [scene[name] for name in plan.context], []
    for view, frame in zip(views, prefetch(lambda view: view.load(), views), strict=True):
        depth = cache.depth(view, frame) if cache.covers(view) else None
        rgb = (frame.rgb / np.float32(255)).astype(np.float32)
        known = (depth.depth, depth.confidence) if depth else (None, None)
        out.append(ContextView(view.name, view.camera, rgb, *known))
    return out


def complete_round(
    plan: Plan, round_targets: RoundTargets, number: int, *, context: Sequence[ContextView],
    folder: Path, console: Console,
) -> dict[str, Any]:  # fmt: skip
    """Round ``number``, from 1: complete and fuse its targets, and write their files."""
    memory, rows = round_targets.memory, plan.schedule[number - 1]
    clock, begun, voxels, total = Clock(), time.perf_counter(), memory.voxels, FuseReport()
    all_stems = target_stems(plan.targets.cameras.names)
    stems, views = [all_stems[row] for row in rows], []
    rig, faces = plan.targets.rig, list[Guidance]()
    pictures = list(rig.pictures(plan.targets.cameras)) if rig else []
    names = target_stems([picture.names[0] for picture in pictures])
    with clock.stage("project"):
        targets = round_targets.of(number)
        before = [target.guidance().coverage for target in targets]
    round_targets.prefetch_round(number + 1)
    results = complete_targets(
        targets, number, memory=memory, completer=plan.completer, context=context,
        config=plan.config, clock=clock,
    )  # fmt: skip
    with ThreadPoolExecutor(WRITERS) as pool:
        writing: list[Future[None]] = []
        for at, result in zip(
            console.track(range(len(targets)), f"round {number}"), results, strict=True
        ):
            total += result.fusion
            camera = camera_entry(targets[at].camera)
            views.append({**result.figures, "stem": stems[at], "camera": camera,
                          "coverage": before[at]})  # fmt: skip
            writing.append(
                pool.submit(
                    write_target,
                    folder,
                    stems[at],
                    guidance=result.guidance,
                    completion=result.completion,
                    fused=result.fused,
                )
            )
            if rig is not None:
                everywhere = np.ones_like(result.guidance.valid)
                faces.append(replace(result.guidance, rgb=result.completion.rgb, valid=everywhere))
                if len(faces) == len(rig.faces):
                    whole = rows[at] // len(faces)
                    path = target_picture(folder, PANORAMA, names[whole])
                    writing.append(
                        pool.submit(_write_whole, path, pictures[whole], rig=rig, faces=faces)
                    )
                    faces = []
        with clock.stage("project"):
            after = [target.guidance() for target in targets]
        for view, guidance in zip(views, after, strict=True):
            view["coverage_after"] = guidance.coverage
            writing.append(pool.submit(write_after, folder, view["stem"], guidance))
        for written in writing:
            written.result()
    refused = [view for view in views if not view["scale"]["accepted"]]
    if refused:
        console.warn(
            f"round {number}: {len(refused)} of {len(views)} completions give no points, first "
            f"{refused[0]['name']}: {refused[0]['scale']['description']}"
        )
    report = _round_report(number, memory, total, clock=clock, begun=begun, voxels=voxels)
    return report | {
        "coverage_before": float(np.mean(before)),
        "coverage_after": float(np.mean([guidance.coverage for guidance in after])),
        "views": views,
    }


def _write_whole(path: Path, camera: Cameras, *, rig: Rig, faces: Sequence[Guidance]) -> None:
    """Write the picture that completed targets are the faces of."""
    picture = to_bytes(rig.joined(faces, camera).rgb[0])
    (write_panorama if rig.lens == "equirectangular" else write_png)(path, picture)


def _round_report(
    number: int, memory: SpatialMemory, total: FuseReport, *, clock: Clock, begun: float,
    voxels: int,
) -> dict[str, Any]:  # fmt: skip
    """A round's report, JSON-ready.

    ``points``, ``observed`` (by cameras), ``scanned`` and ``generated`` count observations in the
    memory after the round; ``scan`` tells of the scan that it starts from; ``added``, ``merged``
    and ``rejected`` are those of FuseReport; ``coverage_*`` are mean shares of target pixels (0 to
    1) that the memory projects to, None in round 0; ``bytes`` is its size.
    """
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
        "dropped": {},
        "depth": [],
        "scan": None,
        "coverage_before": None,
        "coverage_after": None,
        "seconds": {**clock.seconds, "total": time.perf_counter() - begun},
        "bytes": memory.nbytes,
        "views": [],
    }


def complete_targets(
    targets: Sequence[CachedProjection], number: int, *, memory: SpatialMemory,
    completer: Completer, context: Sequence[ContextView], config: RunSettings, clock: Clock,
) -> Iterator[TargetResult]:  # fmt: skip
    """Complete, align and fuse targets, in order.

    A completer that takes several targets in a call (``batches_targets``) gets all of one size
    together; for any other, each view is completed on what the views before it added, so that they
    agree with each other. ``targets`` project ``memory``, and follow what is fused into it.
    """
    seed, together = config.seed + number, None
    if completer.batches_targets:
        with clock.stage("project"):
            guidances = [target.guidance() for target in targets]
        with clock.stage("complete"):
            together = _completed_together(completer, context, guidances, seed=seed)
    for row, target in enumerate(targets):
        if together is not None:
            guidance, completion = guidances[row], together[row]
        else:
            with clock.stage("project"):
                guidance = target.guidance()
            with clock.stage("complete"):
                completion = run_completer(completer, context, guidance, seed=seed)
        if not completion.whole:
            completion = replace(completion, rgb=target.colored(guidance, completion.rgb))
        yield _align_and_fuse(
            guidance, completion, number, memory=memory, config=config, clock=clock
        )


def _completed_together(
    completer: Completer, context: Sequence[ContextView], guidances: Sequence[Guidance], *,
    seed: int,
) -> list[Completion]:  # fmt: skip
    """One completion (V = 1) per target, of one call per image size."""
    completions: dict[int, Completion] = {}
    sizes: dict[tuple[int, ...], list[int]] = {}
    for index, guidance in enumerate(guidances):
        sizes.setdefault(guidance.valid.shape[1:], []).append(index)
    for rows in sizes.values():
        of_one_size = concatenate([guidances[index] for index in rows])
        completion = run_completer(completer, context, of_one_size, seed=seed)
        for place, index in enumerate(rows):
            completions[index] = completion.select(slice(place, place + 1))
    return [completions[index] for index in range(len(guidances))]


def _align_and_fuse(
    guidance: Guidance,
    completion: Completion,
    number: int,
    *,
    memory: SpatialMemory,
    config: RunSettings,
    clock: Clock,
) -> TargetResult:
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
    return TargetResult(guidance, completion, fused, report, figures)


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
    return ScaleAlignment.of_fit(align_depth_scale(
        depth, guidance.depth[0], valid=guidance.valid[0] & (depth > 0),
        confidence=guidance.confidence[0], max_residual=config.fusion.max_scale_residual,
    ))  # fmt: skip
