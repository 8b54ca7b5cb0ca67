"""``gvtools evaluate``, ``judge`` and ``trajectory``: measures against references."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from gvtools.errors import DegenerateError, OptionError
from gvtools.files import folder_for_results
from gvtools.runs.layout import RECORD
from gvtools.scenes.layout import FORM, is_address
from pipelines.commands.arguments import MeasurementArguments, RootArguments, SceneArguments
from pipelines.options import Arguments, JsonArguments

if TYPE_CHECKING:
    from gvtools.evaluation.trajectories import PoseErrors
    from pipelines.console import Console
    from pipelines.scoring.judging import JudgeReference


class ProtocolArguments(Arguments):
    """Of a run that is made to be measured."""

    title = "running the protocol on a project first"

    protocol: Literal["pass", "long"] | None = None
    """Pass: 2 context and 6 target views; long: three rounds of 6."""
    stride: int | None = None
    """Views from one to the next (default: widest). [N]"""
    completer: str | None = None
    """Default inpaint. [NAME]"""
    profile: str | None = None
    """Fast, balanced, accurate or finest. [NAME]"""
    set: tuple[str, ...] = ()
    """A setting. [KEY=VALUE]"""


class EvaluateCommand(MeasurementArguments, ProtocolArguments, SceneArguments):
    """Measure finished runs: pictures, consistency, poses, beside published figures."""

    examples = (
        "gvtools evaluate runs/kitchen --json kitchen.json",
        "gvtools evaluate scans/kitchen --protocol long --stride 3 --out runs/kitchen_long",
    )
    positional = ("runs",)

    runs: tuple[Path, ...]
    """A run, several, or (--protocol) a project. [RUN]"""
    out: Path | None = None
    """Default RUN/evaluation. [DIR]"""
    against: tuple[str, ...] = ()
    """Print its published rows beside the measured one: dl3dv, realestate10k, mipnerf360,
    scannetv2, llff, ... or all; the files hold all with the paper's protocol. [BENCHMARK]"""
    data_set: str | None = None
    """That the runs are scenes of; without it nothing is ranked. [NAME]"""
    name: str = "gvtools"
    """Of the measured row. [NAME]"""
    project: Path | None = None
    """Where the run's project lies, if it was moved. [DIR]"""

    def run(self, console: Console) -> None:
        from gvtools.evaluation.published import benchmark_names
        from pipelines.scoring import evaluation

        shown = benchmark_names() if "all" in self.against else self.against
        benchmarks = evaluation.load_benchmarks(shown, self.data_set)
        if self.project is not None and len(self.runs) > 1:
            raise OptionError("--project: names the project of one run; give one run")
        out = _folder(self)
        options = self.measures()
        paths: Sequence[Path] = self.runs
        if self.protocol is not None:
            paths = [
                evaluation.run_protocol(
                    self.open_scene(self.runs[0]), out, protocol=self.protocol,
                    stride=self.stride, seed=self.seed, completer=self.completer,
                    profile=self.profile, changes=self.set, reading=self.reading(),
                    console=console,
                )
            ]  # fmt: skip
        runs = evaluation.load_runs(paths, project=self.project)
        with folder_for_results(out):
            evaluations = evaluation.evaluate_runs(runs, options, console=console)
            figures = evaluation.write_evaluation(
                runs,
                evaluations,
                options,
                name=self.name,
                data_set=self.data_set,
                benchmarks=benchmarks,
                shown=shown,
                out=out,
                console=console,
            )
        self.write_json(figures)


def _folder(args: EvaluateCommand) -> Path:
    if args.protocol is not None:
        if args.out is None or len(args.runs) != 1:
            raise OptionError(
                "--protocol: needs one project, and --out for the run and its figures"
            )
        return args.out
    args.refuse(("stride", "completer", "profile", "set"), "belongs to --protocol")
    if args.out is not None:
        return args.out
    if len(args.runs) > 1:
        raise OptionError("several runs: expected --out for their common figures")
    return args.runs[0] / "evaluation"


class JudgeCommand(MeasurementArguments, SceneArguments):
    """Judge pictures of any method, several side by side, with the figures of evaluate."""

    examples = (
        "gvtools judge runs/kitchen gsplat/results/kitchen nerfstudio/renders --against "
        "runs/kitchen --out judged",
        "gvtools judge renders --against scans/kitchen --context not:every:8 --targets every:8 "
        "--out judged",
    )
    positional = ("pictures",)

    pictures: tuple[Path, ...]
    """Of one method each: a folder of pictures, a run of gvtools, or what nerfstudio, gsplat or
    NerfBaselines wrote. [PICTURES]"""
    against: Path
    """A finished run (its targets, truths, memory and settings count), or a project. [PROJECT]"""
    name: tuple[str, ...] = ()
    """Of a method, in their order. [NAME]"""
    context: str | None = None
    """Of a project: the views that were given. [SPEC]"""
    targets: str | None = None
    """Of a project: the views that the pictures stand for. [SPEC]"""
    cameras: Path | None = None
    """A TUM, KITTI or EuRoC trajectory with the cameras of the pictures, where they are none of the
    project's; figures that need a truth are left out then. [FILE]"""
    match: Literal["auto", "name", "order"] = "auto"
    """Pictures with views: by name, or by order where no name matches."""
    out: Path
    """For the results. [DIR]"""
    sheet_views: int = Field(12, ge=0)
    """Views on contact sheets. [N]"""

    def run(self, console: Console) -> None:
        from pipelines.scoring.judging import judge, method_names

        names = method_names(self.pictures, self.name)
        _check_apart(self.pictures, self.out)
        options = self.measures()
        with folder_for_results(self.out):
            figures = judge(
                self.pictures,
                names,
                _reference(self, console),
                options=options,
                rule=self.match,
                sheet_views=self.sheet_views,
                out=self.out,
                console=console,
            )
        self.write_json(figures)


def _check_apart(pictures: Sequence[Path], out: Path) -> None:
    """Refuse results among the pictures, where the next call would take sheets for pictures."""
    for path in pictures:
        if out.resolve().is_relative_to(path.resolve()) and not (path / RECORD).is_file():
            raise OptionError(f"--out {out}: lies in the pictures {path}; give a folder elsewhere")


def _reference(args: JudgeCommand, console: Console) -> JudgeReference:
    from pipelines.scoring.judging import open_reference, reference_from_context

    if (args.against / RECORD).is_file():
        args.refuse(("context", "targets"), f"{args.against} is a run, whose views are its own")
        return open_reference(args.against, cameras=args.cameras)
    return reference_from_context(
        args.open_scene(args.against),
        args.out / "memory",
        context=args.context,
        targets=args.targets,
        cameras=args.cameras,
        reading=args.reading(),
        console=console,
    )


# All pairs of longer trajectories are too many, and say no more.
MOST_FOR_AUC = 2000


class TrajectoryCommand(RootArguments, JsonArguments):
    """Measure the pose errors (ATE, RPE, AUC) of a trajectory against its reference."""

    examples = (
        "gvtools trajectory ate groundtruth.txt estimate.txt --align sim3",
        "gvtools trajectory rpe colmap/sparse/0 runs/mine --delta 10 --all-pairs --json rpe.json",
    )
    positional = ("metric", "reference", "estimate")

    metric: Literal["ate", "rpe"]
    """Absolute or relative error."""
    reference: Path
    """A TUM, KITTI or EuRoC file, a COLMAP model, a project, or a run. [REFERENCE]"""
    estimate: Path
    """Likewise. [ESTIMATE]"""
    align: Literal["none", "se3", "sim3"] = "sim3"
    """Of the estimate's centres to the reference's."""
    delta: int = 1
    """Of rpe: frames from the first pose of a pair to the second. [N]"""
    all_pairs: bool = False
    """Of rpe: pairs start at every frame; else each where the last one ended."""
    associate: Literal["auto", "time", "name", "index"] = "auto"
    """Auto: by what both have, in the order time, name, index."""
    max_difference: float = Field(0.01, ge=0)
    """Of times that belong together. [seconds]"""
    offset: float = 0.0
    """To add to the estimate's. [seconds]"""
    layout: Literal["auto", "tum", "kitti", "euroc"] = "auto"
    """Of trajectory files."""
    allow_mirrored: bool = False
    """Give figures also where the estimate is the reference's mirror image."""

    def run(self, console: Console) -> None:
        from gvtools.evaluation.trajectories import (
            absolute_errors,
            pose_auc,
            relative_errors,
            wrong_conventions,
        )
        from pipelines.inputs.trajectory_source import associate, open_trajectory
        from pipelines.scoring.measurement import pose_figures

        if self.metric == "ate":
            self.refuse(("delta", "all_pairs"), "belongs to rpe")
        paths = (self.reference, self.estimate)
        if not any(map(is_address, paths)):
            self.refuse(("root",), f"belongs to {FORM}")
        reference, estimate = (
            open_trajectory(path, layout=self.layout, root=self.root) for path in paths
        )
        tracks = zip(paths, (reference, estimate), strict=True)
        notes: dict[str, Sequence[str]]
        notes = {"reading": [f"{path}: {note}" for path, track in tracks for note in track.notes]}
        for note in notes["reading"]:
            console.warn(note)
        first, second, how, notes["association"] = associate(
            reference,
            estimate,
            how=self.associate,
            max_difference=self.max_difference,
            offset=self.offset,
        )
        poses = reference.poses[first], estimate.poses[second]
        notes["conventions"] = wrong_conventions(*poses, align=self.align)
        for note in (*notes["association"], *notes["conventions"]):
            console.warn(note)
        measure, auc = absolute_errors, None
        if self.metric == "rpe":
            measure = partial(relative_errors, delta=self.delta, all_pairs=self.all_pairs)
        elif len(first) <= MOST_FOR_AUC:
            auc = pose_auc(*poses)
        errors = measure(*poses, align=self.align, refuse_mirrored=not self.allow_mirrored)
        pairs = {"delta": self.delta, "delta_unit": "frames", "all_pairs": self.all_pairs}
        figures = {
            "metric": self.metric,
            "align": self.align,
            "association": how,
            "poses_reference": len(reference),
            "poses_estimate": len(estimate),
            "associated": len(first),
            **(pairs if self.metric == "rpe" else {}),
            **pose_figures(errors, auc),
        }
        if self.metric == "ate" and auc is None:
            figures["notes"]["auc"] = f"not measured over more than {MOST_FOR_AUC} poses"
        figures["notes"] |= {name: lines for name, lines in notes.items() if lines}
        if not self.write_json(figures) and errors.ok:
            _print(figures, errors, console)
        if not errors.ok:
            raise DegenerateError(f"no figures: {errors.status}")


def _print(figures: dict[str, Any], errors: PoseErrors, console: Console) -> None:
    from pipelines.scoring.measurement import POSE_STATISTICS, statistics_figures

    console.line(
        f"{figures['metric'].upper()}: {figures['associated']} poses of "
        f"{figures['poses_reference']} and {figures['poses_estimate']}, associated by "
        f"{figures['association']}; {figures['status']}"
        + (f", scale {errors.scale:.6g}" if figures["align"] == "sim3" and errors.scale else "")
    )
    if figures["metric"] == "rpe":
        start = "at every frame" if figures["all_pairs"] else "where the last ended"
        console.line(f"pairs {figures['delta']} frame(s) of these poses apart, starting {start}")
    columns = (*POSE_STATISTICS, "n")
    rows = {
        "translation, scene units": statistics_figures(errors.translation),
        f"translation / extent {errors.extent:.4g}": statistics_figures(errors.translation_share),
        "rotation, degrees": statistics_figures(errors.rotation_deg),
    }
    values = [[name, *(row[key] for key in columns)] for name, row in rows.items()]
    console.table(["error", *columns], values)
    if figures.get("auc"):
        shares = ", ".join(
            f"@{key} {value:.4f}" for key, value in figures["auc"].items() if value is not None
        )
        console.line(f"pose AUC over {figures['auc_pairs']} pairs, degrees: {shares or '-'}")
