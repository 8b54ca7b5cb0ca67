"""The runs of blocks made one: every view observed once, in the order that one run has.

A memory's observations are means of what several views saw, so memories cannot be added: views of
two blocks that merged in neither would have merged in one. What decides the observations is kept
instead, and they are made again by the very code of a run: the whole project's views in the order
of their names, at the whole project's voxel edge and frame, with the poses and the computed depth
of the block that owns each view. With recorded depth, and poses that no block moved, the result is
that of a run of the whole project to the bit. What is dear (depth, fitting, completion) is not
repeated.
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

from gvtools.cameras import concatenate
from gvtools.completers.base import Completer, Completion, ContextView, ScaleAlignment, ScaleStatus
from gvtools.errors import OptionError, ProjectError
from gvtools.files import link_or_copy
from gvtools.guidance import Guidance
from gvtools.runs.context_depth import context_depth_files
from gvtools.runs.folder import RunDirectory
from gvtools.runs.layout import APPEARANCE, POSES, round_folder
from gvtools.runs.poses import RunPoses, refined_poses_of
from gvtools.runs.run import Run, RunTarget, load_run
from gvtools.scenes.project import open_recorded
from gvtools.settings import dotted, with_values
from pipelines.blocks.appearance import BlockAppearance, fit_across, join_appearances
from pipelines.blocks.block import FILE, SceneBlock
from pipelines.blocks.split import by_name, read_blocks
from pipelines.reconstruction.plan import Plan, Targets, describe, run_identity
from pipelines.reconstruction.prepare import make_plan, placed_scan
from pipelines.reconstruction.run import Draw, compile_kernels, complete_run, saved_fit, say_results
from pipelines.reconstruction.settings import RunSettings

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene
    from pipelines.console import Console
    from pipelines.reconstruction.fitting import Fitted


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
    """The runs of all blocks of one split, in order of the blocks' names.

    ``blocks``: where the split lies now; None: where it lay.
    """
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
    order = by_name({name: item.block for name, item in found.items()}, what="the given runs")
    runs = [found[block.name] for block in order]
    _check_alike(runs)
    return runs


def _check_alike(runs: Sequence[BlockRun]) -> None:
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
    runs: Sequence[BlockRun], context: Sequence[str], names: Sequence[str], *,
    targets: Mapping[str, RunTarget],
) -> RunPoses | None:  # fmt: skip
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
    from pipelines.reconstruction.fitting import Fitted
    from pipelines.reconstruction.voxel import grid_frame

    files = [round_folder(item.run.path, 0) / APPEARANCE for item in runs]
    without = [
        str(item.run.path) for item, file in zip(runs, files, strict=True) if not file.exists()
    ]
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
        appearance, plan.poses, spread=any(fitted.spread for fitted in found),
        steps=min(fitted.steps for fitted in found),
    )  # fmt: skip
    return fit_across(plan, fitted, [item.block for item in runs], console=console)
