"""The tables of an evaluation: views, means with intervals, and published rows beside ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gvtools.evaluation.published import Benchmark
from gvtools.evaluation.ranking import MeasuredRow, Setting, comparison_table, side_by_side
from gvtools.evaluation.tables import Column, Table, Value, render
from gvtools.evaluation.view_figures import FIGURES
from gvtools.files import write_text
from pipelines.report.nested import nested

BETTER = {"psnr": "higher", "ssim": "higher", "lpips": "lower", "depth": "lower"}
UNITS = {"psnr": "dB"}
DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3, "depth": 4}
# Figures of consistency and of poses: name, where evaluation.json has the value, and how many.
CONSISTENCY: tuple[tuple[str, tuple[str, ...], tuple[str, ...]], ...] = (
    ("depth reprojection, pixels", ("depth_reprojection", "mean_pixels"),
     ("depth_reprojection", "pairs")),
    ("depth reprojection, relative", ("depth_reprojection", "mean_relative_depth"),
     ("depth_reprojection", "pairs")),
    ("depth contradicting, share", ("depth_reprojection", "contradicting_share"),
     ("depth_reprojection", "pairs")),
    ("verified matches a pair", ("geometric_verification", "mean_verified"),
     ("geometric_verification", "images")),
    ("registered, share", ("geometric_verification", "registered_share"),
     ("geometric_verification", "images")),
    ("triangulated matches, share", ("geometric_verification", "triangulated_share"), ()),
    ("reprojection at given poses, pixels", ("geometric_verification", "mean_reprojection"),
     ("geometric_verification", "points")),
    ("epipolar distance, pixels", ("geometric_verification", "epipolar"), ()),
)  # fmt: skip
POSES: tuple[tuple[str, tuple[str, ...], tuple[str, ...]], ...] = (
    ("located, share", ("success_share",), ("pictures",)),
    ("rotation error, median, degrees", ("rotation_error_deg", "median"),
     ("rotation_error_deg", "n")),
    ("centre error, median, scene units", ("center_error", "median"), ("center_error", "n")),
    ("ATE (Sim(3)), rmse, scene units", ("ate_sim3", "rmse"), ("ate_sim3", "n")),
    ("ATE (Sim(3)), rmse, share of extent", ("ate_sim3", "translation_share", "rmse"),
     ("ate_sim3", "n")),
    ("RPE (Sim(3)), rmse, scene units", ("rpe_sim3", "rmse"), ("rpe_sim3", "n")),
    ("RPE (Sim(3)), rmse, share of extent", ("rpe_sim3", "translation_share", "rmse"),
     ("rpe_sim3", "n")),
    ("RPE (Sim(3)), rmse, degrees", ("rpe_sim3", "rotation_deg", "rmse"), ("rpe_sim3", "n")),
    ("pose AUC at 3 degrees, failures as wrong", ("auc", "3"), ("pictures",)),
    ("pose AUC at 30 degrees, failures as wrong", ("auc", "30"), ("pictures",)),
)  # fmt: skip
SUFFIXES = {"csv": ".csv", "markdown": ".md", "latex": ".tex"}


def view_table(views: Sequence[Mapping[str, Any]], caption: str) -> Table:
    """One row a view."""
    plain = ["name", "round", "coverage", "coverage_after", "observed"]
    columns = [Column("view"), Column("round")]
    columns += [Column(name, digits=3) for name in plain[2:]]
    columns += [_column(name) for name in FIGURES]
    rows = [tuple(view[name] for name in (*plain, *FIGURES)) for view in views]
    return Table(tuple(columns), tuple(rows), caption)


def summary_table(
    evaluations: Sequence[Mapping[str, Any]],
    caption: str,
    over_scenes: Mapping[str, Mapping[str, Any]],
) -> Table:
    """One row a figure and run: mean, its interval, each round, and the true pictures' figure.

    Args:
        evaluations: one a run.
        caption: above the table.
        over_scenes: means of the runs' means, for a block of their own; empty for a single run.
    """
    rounds = max(evaluation["rounds"] for evaluation in evaluations)
    columns = [Column("run"), Column("figure"), Column("mean", digits=4)]
    columns += [Column(end, digits=4) for end in ("low", "high")]
    columns += [Column("n"), *(Column(f"round {i + 1}", digits=4) for i in range(rounds))]
    columns.append(Column("true pictures", digits=4))
    rows: list[tuple[Value, ...]] = []
    notes = [
        "low and high: 95 % bootstrap interval of the mean; true pictures: the same measure on the "
        "photographs that the targets stand for"
    ]
    for evaluation in evaluations:
        name = evaluation["name"]
        images = evaluation.get("images", {"mean": {}, "rounds": [], "notes": {}})
        for figure, value in images["mean"].items():
            by_round = {part["round"]: part[figure]["mean"] for part in images["rounds"]}
            ends = value["mean"], value["low"], value["high"], value["n"]
            rows.append((name, figure, *ends, *(by_round.get(i + 1) for i in range(rounds)), None))
        for figure, mean, low, high, n, true in scalars(evaluation):
            rows.append((name, figure, mean, low, high, n, *[None] * rounds, true))
        notes += [f"{name}: {key}: {text}" for key, text in images["notes"].items()]
        notes += [f"{name}: {text}" for text in _without_figures(evaluation)]
    for figure, interval in over_scenes.items():
        ends = interval["mean"], interval["low"], interval["high"], interval["n"]
        rows.append(("all scenes", figure, *ends, *[None] * rounds, None))
    if any(evaluation.get("poses", {}).get("located") for evaluation in evaluations):
        notes.append(
            "pose figures are over the located pictures; a completed picture repeats what the "
            "context shows, and is located more exactly than a photograph at recorded poses: read "
            "them beside the true pictures"
        )
    return Table(tuple(columns), tuple(rows), caption, tuple(notes))


Scalar = tuple[str, float | None, float | None, float | None, int | None, float | None]


def scalars(evaluation: Mapping[str, Any]) -> list[Scalar]:
    """Consistency and pose figures: name, value, interval, how many, and of the true pictures."""
    out: list[Scalar] = []
    consistency = evaluation.get("consistency")
    if consistency:
        ours, true = consistency["generated"], consistency.get("true_pictures")
        for label, keys, n in CONSISTENCY:
            out.append((label, nested(ours, *keys), None, None, _count(ours, n),
                        nested(true, *keys)))  # fmt: skip
        features = ours["feature_consistency"]
        score = features["score"]
        out.append((
            "feature consistency", score["mean"], score["low"], score["high"], score["n"],
            nested(true, "feature_consistency", "score", "mean"),
        ))  # fmt: skip
        label = "feature consistency of unrelated content"
        out.append((label, features["unrelated"], None, None, None, None))
    poses = evaluation.get("poses", {})
    if poses.get("success_share") is not None:
        left_out, true = poses.get("context_left_out"), poses.get("true_pictures")
        for label, keys, n in POSES:
            if keys[0] in poses:
                out.append((label, nested(poses, *keys), None, None, _count(poses, n),
                            nested(true, *keys)))  # fmt: skip
        for label, keys, n in POSES:
            if left_out and keys[0] in left_out:
                out.append((f"context left out: {label}", nested(left_out, *keys), None, None,
                            _count(left_out, n), None))  # fmt: skip
    return out


def _count(part: Mapping[str, Any], keys: Sequence[str]) -> int | None:
    found = nested(part, *keys) if keys else None
    return len(found) if isinstance(found, list | tuple) else found


def _without_figures(evaluation: Mapping[str, Any]) -> list[str]:
    """Why parts have no figure."""
    out = []
    for kind, part in evaluation.get("consistency", {}).items():
        label = "" if kind == "generated" else "true pictures: "
        for name in ("depth_reprojection", "geometric_verification", "met3r"):
            status = part.get(name, {}).get("status", "")
            if status.startswith(("empty", "unavailable")):
                out.append(f"{label}{name.replace('_', ' ')}: {status}")
        if not part["feature_consistency"]["pairs"]:
            out.append(f"{label}feature consistency: empty: a single view has no pairs")
    poses = evaluation.get("poses", {})
    for label, part in (("", poses), ("true pictures: ", poses.get("true_pictures") or {})):
        if str(part.get("status", "")).startswith("degenerate"):
            out.append(f"{label}poses: {part['status']}")
        for key in ("ate_sim3", "rpe_sim3"):
            status = part.get(key, {}).get("status", "")
            if status.startswith("degenerate"):
                out.append(f"{label}{key.split('_')[0].upper()}: {status}")
    return list(dict.fromkeys(out))


def comparison(row: MeasuredRow, benchmark: Benchmark) -> Table:
    """Published rows of a benchmark with the measured one beside them."""
    return comparison_table(side_by_side([row], benchmark), benchmark)


def measured_row(
    name: str, evaluations: Sequence[Mapping[str, Any]], setting: Setting
) -> MeasuredRow:
    """The protocol's figures: means over scenes of what each scene's views come to.

    The time is that of all rounds, as published.
    """

    def mean(*keys: str) -> float | None:
        values = [nested(evaluation, *keys) for evaluation in evaluations]
        known = [value for value in values if value is not None]
        return sum(known) / len(known) if len(known) == len(values) and known else None

    figures = {
        "psnr": mean("images", "mean", "psnr", "mean"),
        "ssim": mean("images", "mean", "ssim", "mean"),
        "lpips": mean("images", "mean", "lpips", "mean"),
        "ate": mean("poses", "ate_sim3", "rmse"),
        "rpe_r": mean("poses", "rpe_sim3", "rotation_deg", "rmse"),
        "rpe_t": mean("poses", "rpe_sim3", "rmse"),
        "reproj": None,
        "met3r": mean("consistency", "generated", "met3r", "score", "mean"),
        "time": mean("seconds_of_rounds"),
    }
    return MeasuredRow(name, figures, setting)


def write_tables(folder: Path, tables: Mapping[str, Table]) -> list[Path]:
    """Each table as CSV, Markdown and LaTeX; returns the files."""
    out = []
    for name, table in tables.items():
        for form, suffix in SUFFIXES.items():
            path = folder / f"{name}{suffix}"
            write_text(path, render(table, form))
            out.append(path)
    return out


def _column(figure: str) -> Column:
    kind = figure.split("_")[0]
    return Column(figure, UNITS.get(kind, ""), BETTER[kind], DIGITS[kind])
