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

BETTER = {"psnr": "higher", "ssim": "higher", "lpips": "lower", "depth": "lower"}
UNITS = {"psnr": "dB"}
DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3, "depth": 4}
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
            by_round = [part[figure]["mean"] for part in images["rounds"]]
            by_round += [None] * (rounds - len(by_round))
            ends = value["mean"], value["low"], value["high"], value["n"]
            rows.append((name, figure, *ends, *by_round, None))
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
        ours = dict(_consistency_figures(consistency["generated"]))
        true = dict(_consistency_figures(consistency.get("true_pictures")))
        for label, (value, low, high, n) in ours.items():
            out.append((label, value, low, high, n, true.get(label, (None,))[0]))
        features = consistency["generated"]["feature_consistency"]
        label = "feature consistency of unrelated content"
        out.append((label, features["unrelated"], None, None, None, None))
    poses = evaluation.get("poses", {})
    parts = [_pose_figures(poses), _pose_figures(poses.get("true_pictures"))]
    for label, (value, n) in parts[0].items():
        out.append((label, value, None, None, n, parts[1].get(label, (None,))[0]))
    for label, (value, n) in _pose_figures(poses.get("context_left_out")).items():
        out.append((f"context left out: {label}", value, None, None, n, None))
    return out


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


Quad = tuple[float | None, float | None, float | None, int | None]


def _consistency_figures(part: Mapping[str, Any] | None) -> list[tuple[str, Quad]]:
    if not part:
        return []
    depth, geometry = part["depth_reprojection"], part["geometric_verification"]
    features = part["feature_consistency"]
    score, pairs = features["score"], len(depth["pairs"])
    plain = (
        ("depth reprojection, pixels", depth["mean_pixels"], pairs),
        ("depth reprojection, relative", depth["mean_relative_depth"], pairs),
        ("depth contradicting, share", depth["contradicting_share"], pairs),
        ("verified matches a pair", geometry["mean_verified"], geometry["images"]),
        ("registered, share", geometry["registered_share"], geometry["images"]),
        ("triangulated matches, share", geometry["triangulated_share"], None),
        ("reprojection at given poses, pixels", geometry["mean_reprojection"], geometry["points"]),
        ("epipolar distance, pixels", geometry["epipolar"], None),
    )
    network = features["network"]
    label = f"feature consistency ({network})" if network else "feature consistency"
    return [(name, (value, None, None, n)) for name, value, n in plain] + [
        (label, (score["mean"], score["low"], score["high"], score["n"]))
    ]


def _pose_figures(part: Mapping[str, Any] | None) -> dict[str, tuple[float | None, int | None]]:
    if not part or part.get("success_share") is None:
        return {}
    out: dict[str, tuple[float | None, int | None]] = {
        "located, share": (part["success_share"], part["pictures"])
    }
    for key, label in (
        ("rotation_error_deg", "rotation error, median, degrees"),
        ("center_error", "centre error, median, scene units"),
    ):
        found = part[key]
        out[label] = (found["median"], found["n"]) if found else (None, 0)
    for key in ("ate_sim3", "rpe_sim3"):
        if key in part:
            label = f"{key.split('_')[0].upper()} (Sim(3)), rmse"
            figures = part[key]
            out[f"{label}, scene units"] = (figures["rmse"], figures["n"])
            out[f"{label}, share of extent"] = (figures["translation_share"]["rmse"], figures["n"])
            if key == "rpe_sim3":
                out[f"{label}, degrees"] = (figures["rotation_deg"]["rmse"], figures["n"])
    auc = part.get("auc")
    if auc:
        out["pose AUC at 3 degrees, failures as wrong"] = (auc["3"], part["pictures"])
        out["pose AUC at 30 degrees, failures as wrong"] = (auc["30"], part["pictures"])
    return out


def comparison(row: MeasuredRow, benchmark: Benchmark) -> Table:
    """Published rows of a benchmark with the measured one beside them."""
    return comparison_table(side_by_side([row], benchmark), benchmark)


def measured_row(
    name: str, evaluations: Sequence[Mapping[str, Any]], setting: Setting
) -> MeasuredRow:
    """The protocol's figures: means over scenes of what each scene's views come to.

    The time is that of all rounds, as published.
    """

    def mean(values: Sequence[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return sum(known) / len(known) if len(known) == len(values) and known else None

    def image(figure: str) -> float | None:
        return mean([e.get("images", {}).get("mean", {}).get(figure, {}).get("mean")
                     for e in evaluations])  # fmt: skip

    def pose(kind: str, *keys: str) -> float | None:
        values = []
        for evaluation in evaluations:
            value: Any = evaluation.get("poses", {}).get(kind)
            for key in keys:
                value = value.get(key) if value else None
            values.append(value)
        return mean(values)

    met3r = [e.get("consistency", {}).get("generated", {}).get("met3r") for e in evaluations]
    figures = {
        "psnr": image("psnr"),
        "ssim": image("ssim"),
        "lpips": image("lpips"),
        "ate": pose("ate_sim3", "rmse"),
        "rpe_r": pose("rpe_sim3", "rotation_deg", "rmse"),
        "rpe_t": pose("rpe_sim3", "rmse"),
        "reproj": None,
        "met3r": mean([m["score"]["mean"] if m else None for m in met3r]),
        "time": mean([e["seconds_of_rounds"] for e in evaluations]),
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
