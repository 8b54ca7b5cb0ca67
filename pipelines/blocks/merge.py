"""The runs of blocks made one: every view observed once, in the order that one run has.

A memory's observations are means of what several views saw, so memories cannot be added: views of
two blocks that merged in neither would have merged in one. What decides the observations is kept
instead, and they are made again by the very code of a run: the whole project's views in the order
of their names, at the whole project's voxel edge and frame, with the poses and the computed depth
of the block that owns each view. With recorded depth, and poses that no block moved, the result is
that of a run of the whole project to the bit. What is dear (depth, fitting, completion) is not
repeated.

A block's Gaussians were fitted together with those behind its faces, which a merge leaves out and
replaces by another block's. The views that help other blocks see across faces: a short fit to them
brings both sides together.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.appearance import Appearance, Blend
from gvtools.appearance.camera_corrections import Exposures
from gvtools.appearance.fit_options import FitOptions
from gvtools.appearance.gaussians import Gaussians
from gvtools.cameras import concatenate
from gvtools.completers.base import Completer, Completion, ContextView, ScaleAlignment, ScaleStatus
from gvtools.errors import OptionError, ProjectError
from gvtools.files import link_or_copy
from gvtools.guidance import Guidance
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.runs.context_depth import context_depth_files
from gvtools.runs.folder import RunDirectory
from gvtools.runs.layout import APPEARANCE, POSES, round_folder
from gvtools.runs.poses import RunPoses, refined_poses_of
from gvtools.runs.run import Run, RunTarget, load_run
from gvtools.scenes.project import open_recorded
from gvtools.settings import dotted, with_values
from gvtools.splats import HARMONICS, LOG_SCALE, SH, turn_gaussians
from gvtools.view_selection import evenly_spread
from pipelines.blocks.split import FILE, SceneBlock, read_blocks
from pipelines.reconstruction.fitting import Fitted, fit_appearance
from pipelines.reconstruction.plan import Plan, Targets, describe, run_identity
from pipelines.reconstruction.prepare import make_plan, placed_scan
from pipelines.reconstruction.run import Draw, compile_kernels, complete_run, saved_fit, say_results
from pipelines.reconstruction.settings import RunSettings
from pipelines.reconstruction.voxel import grid_frame

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene
    from pipelines.console import Console


Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BlockAppearance:
    """What a block's run fitted."""

    block: SceneBlock
    context: tuple[str, ...]  # its run's context, in the order of the exposures
    appearance: Appearance  # its Gaussians


def join_appearances(parts: Sequence[BlockAppearance], frame: LocalFrame) -> Appearance:
    """One appearance of all blocks'.

    Of each block the Gaussians whose centres lie in its cell. Each block's brightness is relative
    to its own photographs; those that several blocks share tell how their scales differ.
    """
    gains = _centred(brightness([_log_gains(part) for part in parts]), parts)
    first = parts[0].appearance
    count = min(len(part.appearance.fits) for part in parts)
    fits = [
        Gaussians(
            np.concatenate([
                _in_cell(part.appearance.fits[number], part.block, frame, gain=gain)
                for part, gain in zip(parts, gains, strict=True)
            ]),
            frame=frame,
        )
        for number in range(count)
    ]  # fmt: skip
    weights = [len(part.block.owners) for part in parts]
    blends = [part.appearance.blend for part in parts]
    blend = Blend(
        float(np.average([blend.share for blend in blends], weights=weights)),
        float(np.average([blend.tolerance for blend in blends], weights=weights)),
    )
    near = min(part.appearance.near for part in parts)
    surfaces = [
        frame.from_world(part.appearance.gaussians.frame.to_world(part.appearance.surface))
        for part in parts if part.appearance.surface is not None
    ]  # fmt: skip
    # Surfaces of one block say nothing of what is before them in another.
    all_known = len(surfaces) == len(parts)
    surface = np.concatenate(surfaces).astype(np.float32) if all_known else None
    return Appearance(
        fits[0], near, blend, first.splatter, tuple(fits[1:]), _exposures(parts, gains, frame),
        surface, all(part.appearance.backdrop for part in parts),
    )  # fmt: skip


def brightness(parts: Sequence[dict[str, Float64]]) -> Float64:
    """(B, 3) logarithms that each block's exposures lack to one scale, with mean zero.

    ``parts`` are of each block the logarithmic gains (3,) of its photographs, by name.

    >>> one, two = {"a": np.zeros(3), "b": np.ones(3)}, {"b": np.full(3, 0.5), "c": np.zeros(3)}
    >>> brightness([one, two]).round(2)[:, 0].tolist()
    [-0.25, 0.25]
    """
    equations, wanted = [np.ones(len(parts))], [np.zeros(3)]
    for i, one in enumerate(parts):
        for j in range(i + 1, len(parts)):
            shared = sorted(one.keys() & parts[j].keys())
            if shared:
                apart = np.mean([one[name] - parts[j][name] for name in shared], axis=0)
                row = np.zeros(len(parts))
                row[i], row[j] = -1, 1
                # One photograph more, one voice more.
                equations.append(row * np.sqrt(len(shared)))
                wanted.append(apart * np.sqrt(len(shared)))
    found = np.linalg.lstsq(np.array(equations), np.array(wanted), rcond=None)[0]
    return np.asarray(found, np.float64)


def _centred(gains: Float64, parts: Sequence[BlockAppearance]) -> Float64:
    """The blocks' gains, such that the mean of all blocks' own photographs' gains is zero."""
    own = [
        log_gain + gain
        for part, gain in zip(parts, gains, strict=True)
        for name, log_gain in _log_gains(part).items()
        if name in part.block.owners
    ]
    return gains - np.mean(own, axis=0) if own else gains


def _log_gains(part: BlockAppearance) -> dict[str, Float64]:
    exposures = part.appearance.exposures
    if exposures is None or len(exposures.log_gains) != len(part.context):
        return {}
    return dict(zip(part.context, exposures.log_gains, strict=True))


def _in_cell(
    gaussians: Gaussians, block: SceneBlock, frame: LocalFrame, *, gain: Float64
) -> NDArray[np.float32]:
    """The Gaussians in a block's cell, in a frame, dimmed by what their photographs' gains rise."""
    world = gaussians.frame.to_world(gaussians.values[:, :LOG_SCALE])
    inside = block.cell.holds(world)
    if not inside.any():
        return gaussians.values[:0]
    out = turn_gaussians(gaussians.values[inside], frame.axes.T @ gaussians.frame.axes)
    out[:, :LOG_SCALE] = frame.from_world(world[inside])
    return scale_colors(out, -gain)


def scale_colors(values: NDArray[np.float32], log_gain: Float64) -> NDArray[np.float32]:
    """(N, VALUES) Gaussians whose colours are multiplied by the exponential of (3,) logarithms."""
    out, scale = values.copy(), np.exp(log_gain)
    sh = out[:, SH:].reshape(len(out), -1, 3) * scale
    # Colours are 0.5 + their harmonics; it is the whole that changes.
    sh[:, 0] += 0.5 * (scale - 1) / HARMONICS[0]
    out[:, SH:] = sh.reshape(len(out), -1)
    return out


def _exposures(
    parts: Sequence[BlockAppearance], gains: Float64, frame: LocalFrame
) -> Exposures | None:
    """Exposures of all blocks' own photographs by name; None where a block has none."""
    names, poses, logs, depths = [], [], [], []
    for part, gain in zip(parts, gains, strict=True):
        own, exposures = set(part.block.owners), part.appearance.exposures
        if exposures is None or len(exposures.poses) != len(part.context):
            return None
        mine = np.array([name in own for name in part.context])
        world = part.appearance.gaussians.frame.cam_from_world(exposures.poses[mine])
        names += [name for name in part.context if name in own]
        poses.append(frame.cam_from_local(world))
        logs.append(exposures.log_gains[mine] + gain)
        depths.append(exposures.depth)
    order = np.argsort(names)
    log_gains = np.concatenate(logs)[order]
    return Exposures(np.concatenate(poses)[order], log_gains, float(np.median(depths)))


# Of the time, or the steps, that a run would fit to these views for.
SHARE = 0.5
# Photographs that are read at once where no steps are given.
MOST_VIEWS = 1200


def rows_across(context: Sequence[str], blocks: Sequence[SceneBlock]) -> list[int]:
    """Rows of the context views that help another block than their own."""
    helping = {name for block in blocks for name in block.helpers}
    return [row for row, name in enumerate(context) if name in helping]


def fit_across(
    plan: Plan, joined: Fitted, blocks: Sequence[SceneBlock], *, console: Console
) -> Fitted:
    """Joined Gaussians, fitted further to the views that see across faces; poses stay.

    Only these views are read, no more than there are steps: all of a large project's may not fit
    into memory.
    """
    rows, whole = rows_across(plan.context, blocks), joined.appearance
    if not rows or whole.exposures is None:
        return joined
    options = _options(plan.config.refine, fits=len(whole.fits))
    rows = list(evenly_spread(rows, options.steps or MOST_VIEWS))
    console.line(f"fitting: {len(rows)} of {len(plan.context)} views see across blocks")
    some = replace(
        plan,
        context=tuple(plan.context[row] for row in rows),
        config=plan.config.replaced(refine=options),
    )
    # The gains of a fit's photographs have mean zero: what these lack, the Gaussians take on.
    given = whole.exposures.log_gains
    level = given[rows].mean(axis=0)
    exposures = replace(
        whole.exposures, poses=whole.exposures.poses[rows], log_gains=given[rows] - level
    )
    ended = []
    for fit in whole.fits:
        start = replace(whole, gaussians=_brighter(fit, level), others=(), exposures=exposures)
        # The plan has the poses. As if there were no steps, it goes on however far blocks' fits had
        # converged.
        earlier = replace(joined, appearance=start, poses=None, steps=0)
        further = fit_appearance(some, console, earlier=earlier)
        assert further is not None
        ended.append(further)
    fits = [_brighter(further.appearance.gaussians, -level) for further in ended]
    log_gains, found = given.copy(), ended[0].appearance.exposures
    assert found is not None
    log_gains[rows] = found.log_gains + level
    exposures = replace(whole.exposures, log_gains=log_gains)
    appearance = replace(whole, gaussians=fits[0], others=tuple(fits[1:]), exposures=exposures)
    return replace(joined, appearance=appearance, steps=joined.steps + ended[0].steps)


def _options(refine: FitOptions, *, fits: int) -> FitOptions:
    """Options of each of some fits that share the time, or the steps, there is."""
    share = SHARE / fits
    if refine.limit is not None:
        return refine.replaced(poses=False, seconds=share * refine.limit, steps=None)
    return refine.replaced(poses=False, steps=max(1, round(share * (refine.steps or 0))))


def _brighter(gaussians: Gaussians, log_gain: NDArray[np.float64]) -> Gaussians:
    return Gaussians(scale_colors(gaussians.values, log_gain), frame=gaussians.frame)


# What may differ from block to block.
OF_A_BLOCK = ("context", "targets")


@dataclass(frozen=True, eq=False)
class BlockRun:
    """A finished run of a block."""

    run: Run
    block: SceneBlock  # the block that it is of

    @cached_property
    def poses(self) -> dict[str, np.ndarray]:
        """(4, 4) cam_from_world that the run built its memory with, of each view of its own."""
        refined = refined_poses_of(self.run.path)
        if refined is None:
            return {name: self.block.poses[name] for name in self.block.owners}
        found = dict(zip(self.run.context, refined.context, strict=True))
        return {name: found[name] for name in self.block.owners}

    @property
    def held(self) -> dict[str, np.ndarray]:
        """(4, 4) cam_from_world of the views that the block holds out."""
        return {name: self.block.poses[name] for name in self.block.targets}

    @property
    def moved(self) -> bool:
        """Whether the run refined poses of its own."""
        return refined_poses_of(self.run.path) is not None

    def targets(self, *, held_out: bool) -> list[RunTarget]:
        """The run's targets that are the block's own."""
        if held_out != self.held_out:
            return []
        if held_out:
            return [target for target in self.run.views if target.name in self.block.targets]
        inside = self.block.cell.holds
        return [target for target in self.run.views if inside(target.camera.centers).all()]

    @property
    def held_out(self) -> bool:
        """Whether the targets are views of the project."""
        return bool(self.run.record["targets_kind"] == "hold-out")


def read_runs(paths: Sequence[Path], *, blocks: Path | None = None) -> list[BlockRun]:
    """The runs of all blocks of one split, in order of the blocks' names."""
    known = {} if blocks is None else {path.name: path for path, _ in read_blocks(blocks)}
    found: dict[str, BlockRun] = {}
    for path in paths:
        run = load_run(path)
        if not run.complete:
            raise ProjectError(
                f"{path}: {len(run.rounds)} of {run.planned} rounds; expected a finished run; "
                "reconstruct with --resume"
            )
        place = Path(run.record["project"])
        place = known.get(place.name, place) if blocks else place
        if not (place / FILE).is_file():
            raise ProjectError(
                f"{path}: its project {place} is no block, or is gone; expected one that gvtools "
                "split wrote; say by --blocks where the split lies"
            )
        block = SceneBlock.load(place)
        if block.name in found:
            raise OptionError(
                f"{found[block.name].run.path} and {path} are both of block {block.name}; expected "
                "one run of each block"
            )
        missing = sorted(set(block.owners) - set(run.context))
        if missing:
            raise ProjectError(
                f"{path}: its context lacks {missing[0]} and {len(missing) - 1} more of block "
                f"{block.name}; expected --context @{place}/context.txt"
            )
        found[block.name] = BlockRun(run, block)
    return _of_one_split(found)


def _of_one_split(found: Mapping[str, BlockRun]) -> list[BlockRun]:
    """All runs of one split, in order of the blocks' names, with the same settings."""
    blocks = [item.block for item in found.values()]
    split = {(block.names, block.refined) for block in blocks}
    owned = [name for block in blocks for name in block.owners]
    missing = [name for name in blocks[0].names if name not in found]
    if missing:
        raise ProjectError(
            f"the given runs: {len(found)} of {len(blocks[0].names)} blocks; expected all; "
            f"missing: {', '.join(missing)}"
        )
    if len(split) > 1 or len(set(owned)) != len(owned):
        raise ProjectError("the given runs: blocks of different splits; expected those of one")
    runs = [found[name] for name in blocks[0].names]
    first = runs[0].run.record["settings"]
    for item in runs[1:]:
        other = item.run.record["settings"]
        keys = {*first, *other} - set(OF_A_BLOCK)
        different = sorted(key for key in keys if first.get(key) != other.get(key))
        if different:
            raise OptionError(
                f"{item.run.path} and {runs[0].run.path} differ in {', '.join(different)}; "
                "expected runs of the same settings"
            )
    if first.get("protocol") == "paper" or first["fusion"]["generated_as_observed"]:
        raise OptionError(
            f"{runs[0].run.path}: its generated points count as observed ones (protocol paper); "
            "expected them apart, since a merge observes again; reconstruct without"
        )
    return runs


# Confidence of what a block generated, where its run did not keep it.
UNKNOWN = np.float32(0.5)


class BlockCompletions(Completer):
    """Fills holes with what the runs of blocks put there; what the memory shows stays."""

    name = "blocks"

    def __init__(self, targets: Mapping[str, RunTarget]) -> None:
        super().__init__()
        self.targets = targets

    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """The completion of one target; see ``Completer.complete``."""
        name = guidance.cameras.names[0]
        target = self.targets[name]
        files = target.read()
        valid = guidance.valid[0]
        if files.depth.shape != valid.shape:
            raise ProjectError(
                f"{target.folder}: the target {target.name} has {files.depth.shape} pixels; "
                f"expected {valid.shape}; reconstruct the block again"
            )
        scale = target.report["scale"]
        alignment = ScaleAlignment(ScaleStatus(scale["status"]), overlap_px=scale["overlap_px"])
        made = ~valid & (files.depth > 0) & alignment.accepted
        confidence = np.full(valid.shape, UNKNOWN) if files.confidence is None else files.confidence
        known = np.where(valid, guidance.confidence[0], np.float32(0))
        picture = files.picture.astype(np.float32) / np.float32(255)
        rgb = np.where(valid[..., None], guidance.rgb[0], picture)
        depth = np.where(made, files.depth, np.where(valid, guidance.depth[0], np.float32(0)))
        return Completion(
            rgb[None],
            depth[None].astype(np.float32),
            np.where(made, confidence, known)[None].astype(np.float32),
            scale_alignment=(alignment,),
        )


def merge(
    paths: Sequence[Path],
    out: Path,
    *,
    blocks: Path | None = None,  # where the split lies now; None: where it lay
    project: Path | None = None,  # where the whole project lies now; None: where it lay
    resume: bool = False,
    console: Console,
    draw: Draw | None = None,  # see ``pipelines.reconstruction.run.reconstruct``
) -> Path:
    """Merge the runs of all blocks of a split project; returns ``out``."""
    runs = read_runs(paths, blocks=blocks)
    first = runs[0].block
    scene = open_recorded(first.project, first.reading, moved=project)
    plan, targets = _plan(scene, runs, console)
    compile_kernels(plan.config, console)
    describe(plan, console)
    identity = run_identity(plan, first.reading)
    identity["blocks"] = [
        {"name": item.block.name, "run": str(item.run.path.resolve())} for item in runs
    ]
    directory = RunDirectory(out)
    directory.check(identity, resume=resume)
    plan = plan.posed
    if not (resume and directory.reports()):
        # Before the folder is made: a scan that is refused leaves none.
        plan = replace(plan, scan=placed_scan(plan, console))
    with directory.open_or_resume(identity, resume=resume) as done:
        if not done:
            _take_depth(plan, runs, directory)
        fitted = saved_fit(plan, directory) if done else _fitted(plan, runs, console)
        plan = replace(plan, completer=BlockCompletions(targets))
        drawn = complete_run(plan, directory, done, fitted=fitted, console=console, draw=draw)
    say_results(directory, drawn, console)
    return out


def _plan(
    scene: Scene, runs: Sequence[BlockRun], console: Console
) -> tuple[Plan, dict[str, RunTarget]]:
    """The plan of the merged run, and the blocks' targets by their names in it."""
    context = tuple(sorted(name for item in runs for name in item.block.owners))
    # A block without held-out views has some path for its targets.
    held_out = any(item.held_out for item in runs)
    # Block by block; a block's name before those that are no views.
    targets = {
        target.name if held_out else f"{item.block.name}/{target.name}": target
        for item in runs
        for target in item.targets(held_out=held_out)
    }
    names = tuple(sorted(targets)) if held_out else tuple(targets)
    settings = with_values(RunSettings(), dotted(runs[0].run.record["settings"])).replaced(
        context=",".join(context), targets=",".join(names) if held_out else "interpolate:2"
    )
    # What completes, and what is tuned for it, did so in the blocks.
    asked = with_values(settings, {"completer": "none", "tune.minutes": 0.0})
    with tempfile.TemporaryDirectory() as folder:
        poses = _poses(runs, context, names if held_out else ("", ""), targets=targets)
        if poses is not None:
            poses.save(Path(folder) / POSES)
        plan = make_plan(scene, asked, say=console.line, round_0=Path(folder))
    cameras = plan.targets
    if not held_out and names:
        kind = str(runs[0].run.record["targets_kind"])
        moved = concatenate([targets[name].camera for name in names])
        cameras = Targets(replace(moved, names=names), (None,) * len(names), kind)
        if plan.poses is not None:
            plan = replace(plan, poses=replace(plan.poses, targets=moved.cam_from_world))
    # Rows of the targets by the rounds that their blocks had them in.
    schedule = tuple(
        tuple(row for row, name in enumerate(names) if targets[name].round == number)
        for number in sorted({target.round for target in targets.values()})
    )
    config = plan.config.replaced(completer=settings.completer, rounds=len(schedule))
    return replace(
        plan, settings=settings, config=config, targets=cameras, schedule=schedule
    ), targets


def _poses(
    runs: Sequence[BlockRun],
    context: Sequence[str],
    names: Sequence[str],
    *,
    targets: Mapping[str, RunTarget],
) -> RunPoses | None:
    """The poses of context and targets of the merged run; None where they are the project's."""
    if not (runs[0].block.refined or any(item.moved for item in runs)):
        return None
    found = {name: pose for item in runs for name, pose in item.poses.items()}
    found |= {name: pose for item in runs if not item.moved for name, pose in item.held.items()}
    for name in set(names) - found.keys():
        found[name] = targets[name].camera.cam_from_world[0] if name in targets else np.eye(4)
    return RunPoses(
        np.array([found[name] for name in context]),
        np.array([found[name] for name in names]).reshape(-1, 4, 4),
    )


def _take_depth(plan: Plan, runs: Sequence[BlockRun], directory: RunDirectory) -> None:
    """Put the depth that blocks computed for their own views where round 0 looks for it."""
    place = directory.unfinished_round(0)
    wanted = context_depth_files(place, plan.context)
    for item in runs:
        folder = round_folder(item.run.path, 0)
        for name, path in context_depth_files(folder, item.run.context).items():
            if name not in item.block.owners or not path.is_file() or wanted[name].exists():
                continue
            place.mkdir(parents=True, exist_ok=True)
            try:
                for ending in (".png", ".npz"):
                    link_or_copy(path.with_suffix(ending), wanted[name].with_suffix(ending))
            except (OSError, shutil.Error) as error:
                raise ProjectError(
                    f"{path}: cannot be taken over ({error}); free some space and add --resume"
                ) from error


def _fitted(plan: Plan, runs: Sequence[BlockRun], console: Console) -> Fitted | None:
    """The blocks' Gaussians, joined and fitted across faces; None where a block has none."""
    files = [round_folder(item.run.path, 0) / APPEARANCE for item in runs]
    without = [file.parents[1] for file in files if not file.exists()]
    if without:
        if len(without) < len(runs):
            console.warn(
                f"{len(without)} of {len(runs)} blocks have no fitted Gaussians, first "
                f"{without[0]}: "
                "those of the others are left out; give all blocks more time to fit, or none"
            )
        return None
    found = [Fitted.load(file).on(plan.config.device) for file in files]
    parts = [
        BlockAppearance(item.block, item.run.context, fitted.appearance)
        for item, fitted in zip(runs, found, strict=True)
    ]
    appearance = join_appearances(parts, grid_frame(plan.scene, plan.context))
    fitted = Fitted(
        appearance,
        plan.poses,
        spread=any(fitted.spread for fitted in found),
        steps=min(fitted.steps for fitted in found),
    )
    return fit_across(plan, fitted, [item.block for item in runs], console=console)
