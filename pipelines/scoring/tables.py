"""The tables of an evaluation and of a judgement: views, means with intervals, methods compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import combinations
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.evaluation.images import FIGURES
from gvtools.evaluation.published import MeasuredRow, Setting
from gvtools.evaluation.statistics import mean_interval
from gvtools.evaluation.tables import Column, Ranked, Table, Value, csv_text, latex, markdown
from gvtools.files import write_text
from pipelines.report import nested
from pipelines.scoring.measurement import JUDGED, NEVER_OBSERVED

if TYPE_CHECKING:
    from pipelines.console import Console

Figures = Mapping[str, Any]

BETTER = {"psnr": "higher", "ssim": "higher", "lpips": "lower", "depth": "lower"}
UNITS = {"psnr": "dB"}
DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3, "depth": 4}
# Figures of consistency and of poses: name, where evaluation.json has the value, and how many.
CONSISTENCY = (
    ("depth reprojection, pixels", "depth_reprojection.mean_pixels", "depth_reprojection.pairs"),
    ("depth reprojection, relative", "depth_reprojection.mean_relative_depth",
     "depth_reprojection.pairs"),
    ("depth contradicting, share", "depth_reprojection.contradicting_share",
     "depth_reprojection.pairs"),
    ("verified matches a pair", "geometric_verification.mean_verified",
     "geometric_verification.images"),
    ("registered, share", "geometric_verification.registered_share",
     "geometric_verification.images"),
    ("triangulated matches, share", "geometric_verification.triangulated_share", ""),
    ("reprojection at given poses, pixels", "geometric_verification.mean_reprojection",
     "geometric_verification.points"),
    ("epipolar distance, pixels", "geometric_verification.epipolar", ""),
)  # fmt: skip
POSES = (
    ("located, share", "success_share", "pictures"),
    ("rotation error, median, degrees", "rotation_error_deg.median", "rotation_error_deg.n"),
    ("centre error, median, scene units", "center_error.median", "center_error.n"),
    ("ATE (Sim(3)), rmse, scene units", "ate_sim3.rmse", "ate_sim3.n"),
    ("ATE (Sim(3)), rmse, share of extent", "ate_sim3.translation_share.rmse", "ate_sim3.n"),
    ("RPE (Sim(3)), rmse, scene units", "rpe_sim3.rmse", "rpe_sim3.n"),
    ("RPE (Sim(3)), rmse, share of extent", "rpe_sim3.translation_share.rmse", "rpe_sim3.n"),
    ("RPE (Sim(3)), rmse, degrees", "rpe_sim3.rotation_deg.rmse", "rpe_sim3.n"),
    ("pose AUC at 3 degrees, failures as wrong", "auc.3", "pictures"),
    ("pose AUC at 30 degrees, failures as wrong", "auc.30", "pictures"),
)
ENDS = itemgetter("mean", "low", "high", "n")  # of an interval
FORMS = {".csv": csv_text, ".md": markdown, ".tex": latex}


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

    ``over_scenes`` are means of the runs' means, for a block of their own; empty for a single run.
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
            rounds_means = (by_round.get(i + 1) for i in range(rounds))
            rows.append((name, figure, *ENDS(value), *rounds_means, None))
        for figure, mean, low, high, n, true in scalars(evaluation):
            rows.append((name, figure, mean, low, high, n, *[None] * rounds, true))
        notes += [f"{name}: {key}: {text}" for key, text in images["notes"].items()]
        notes += [f"{name}: {text}" for text in _without_figures(evaluation)]
    for figure, interval in over_scenes.items():
        rows.append(("all scenes", figure, *ENDS(interval), *[None] * rounds, None))
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
        out += [_scalar(*entry, part=ours, true=true) for entry in CONSISTENCY]
        features = ours["feature_consistency"]
        score, path = features["score"], "feature_consistency.score.mean"
        out.append(("feature consistency", *ENDS(score), nested(true, path)))
        label = "feature consistency of unrelated content"
        out.append((label, features["unrelated"], None, None, None, None))
    poses = evaluation.get("poses", {})
    if poses.get("success_share") is not None:
        left_out, true = poses.get("context_left_out"), poses.get("true_pictures")
        for part, head, control in (
            (poses, "", true),
            (left_out or {}, "context left out: ", None),
        ):
            for label, path, count in POSES:
                if path.split(".")[0] in part:
                    out.append(_scalar(head + label, path, count, part=part, true=control))
    return out


def _scalar(label: str, path: str, count: str, *, part: Figures, true: Figures | None) -> Scalar:
    number = nested(part, count)
    n = len(number) if isinstance(number, list | tuple) else number
    return label, nested(part, path), None, None, n, nested(true, path)


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


def measured_row(
    name: str, evaluations: Sequence[Mapping[str, Any]], setting: Setting
) -> MeasuredRow:
    """The protocol's figures: means over scenes of what each scene's views come to."""

    def mean(path: str) -> float | None:
        values = [nested(evaluation, path) for evaluation in evaluations]
        known = [value for value in values if value is not None]
        return sum(known) / len(known) if len(known) == len(values) and known else None

    figures = {
        "psnr": mean("images.mean.psnr.mean"),
        "ssim": mean("images.mean.ssim.mean"),
        "lpips": mean("images.mean.lpips.mean"),
        "ate": mean("poses.ate_sim3.rmse"),
        "rpe_r": mean("poses.rpe_sim3.rotation_deg.rmse"),
        "rpe_t": mean("poses.rpe_sim3.rmse"),
        "reproj": None,
        "met3r": mean("consistency.generated.met3r.score.mean"),
        "time": mean("seconds_of_rounds"),
    }
    return MeasuredRow(name, figures, setting)


def print_table(table: Table, console: Console, *, ranks: bool = False) -> None:
    """Print a table with its notes, with ranks as #1 behind the values if they are asked for."""

    def shown(value: Any) -> Any:
        if not isinstance(value, Ranked):
            return value
        if not ranks or value.value is None or value.rank is None:
            return value.value
        return f"{value.value:.4g} #{value.rank}"

    rows = [[shown(value) for value in row] for row in table.rows]
    console.table([column.heading for column in table.columns], rows)
    for note in table.notes:
        console.line(f"  {note}")


def write_tables(folder: Path, tables: Mapping[str, Table]) -> None:
    """Each table as CSV, Markdown and LaTeX."""
    for name, table in tables.items():
        for suffix, form in FORMS.items():
            write_text(folder / f"{name}{suffix}", form(table))


def _column(figure: str) -> Column:
    kind = figure.split("_")[0]
    return Column(figure, UNITS.get(kind, ""), BETTER[kind], DIGITS[kind])


# Heading, unit, better, decimals, and where a measured method has the figure.
SIDE_BY_SIDE = (
    ("PSNR", "dB", "higher", 2, "images.mean.psnr.mean"),
    ("SSIM", "", "higher", 3, "images.mean.ssim.mean"),
    ("LPIPS", "", "lower", 3, "images.mean.lpips.mean"),
    ("PSNR, observed", "dB", "higher", 2, "images.mean.psnr_valid.mean"),
    ("PSNR, never observed", "dB", "higher", 2, "images.mean.psnr_never_observed.mean"),
    ("feature consistency", "", "lower", 3, "consistency.generated.feature_consistency.score.mean"),
    ("located", "share", "higher", 3, "poses.success_share"),
    ("rotation error", "degrees", "lower", 3, "poses.rotation_error_deg.median"),
    ("centre error", "scene units", "lower", 4, "poses.center_error.median"),
)


def judge_tables(figures: Figures) -> dict[str, Table]:
    """The tables of what ``judge.json`` holds: side_by_side, differences, means, views."""
    methods = figures["methods"]
    tables = {"side_by_side": side_by_side(figures)}
    if figures["differences"]:
        tables["differences"] = _differences(figures["differences"])
    tables["means"] = summary_table(methods, "Means with intervals", {})
    if any("images" in method for method in methods):
        tables["views"] = _views(methods)
    return tables


def side_by_side(figures: Figures) -> Table:
    """One row a method, and one of the true pictures where they were measured."""
    methods, total = figures["methods"], len(figures["targets"])
    shown = [row for row in SIDE_BY_SIDE if any(nested(m, row[4]) is not None for m in methods)]
    columns = [Column("method"), Column("views"), Column("matched by")]
    columns += [Column(title, unit, better, digits) for title, unit, better, digits, _ in shown]
    ranks = [_ranks(methods, path, better=better, total=total) for _, _, better, _, path in shown]
    rows: list[tuple[Value, ...]] = []
    for number, method in enumerate(methods):
        cells = [
            Ranked(nested(method, path), rank[number])
            for (_, _, _, _, path), rank in zip(shown, ranks, strict=True)
        ]
        views = f"{method['views']} of {total}"
        rows.append((method["name"], views, method["matched_by"], *cells))
    control = [_control(methods[0], path) for _, _, _, _, path in shown]
    if any(value is not None for value in control):
        rows.append(("true pictures", f"{figures['with_truth']} of {total}", "–", *control))
    return Table(tuple(columns), tuple(rows), "Side by side", tuple(_notes(figures)))


def _ranks(methods: Sequence[Figures], path: str, *, better: str, total: int) -> list[int | None]:
    """Ranks of the methods that have a picture of every view, if there are two; of others None."""
    values = [nested(m, path) if m["views"] == total else None for m in methods]
    known = sorted((v for v in values if v is not None), reverse=better == "higher")
    ranked = len(known) > 1
    return [known.index(v) + 1 if ranked and v is not None else None for v in values]


def _control(method: Figures, path: str) -> float | None:
    """The figure of the true pictures."""
    part, _, rest = path.partition(".")
    if part == "images":
        return None
    value: float | None = nested(method, f"{part}.true_pictures.{rest.removeprefix('generated.')}")
    return value


def _notes(figures: Figures) -> list[str]:
    """How each method was read and matched, and what its figures lack."""
    total, notes = len(figures["targets"]), []
    for method in figures["methods"]:
        parts = [f"{method['layout']}, matched by {method['matched_by']}"]
        if method["missing"]:
            parts.append(
                f"no picture of {len(method['missing'])} of {total} views, means are over the "
                "others and have no rank"
            )
        if method["left_over"]:
            parts.append(f"{len(method['left_over'])} pictures of no judged view left out")
        for entry in method["resized"]:
            width, height = entry["from"]
            parts.append(f"{entry['pictures']} pictures of {width}x{height} pixels resized")
        notes.append(f"{method['name']}: {'; '.join([*parts, *method['reading']])}")
        reasons = nested(method, "images.notes") or {}
        notes += [f"{key}: {why}" for key, why in reasons.items() if key == "lpips"]
    if figures["poses"] != "recorded":
        notes.append(
            f"poses are {figures['poses']}: pictures rendered at recorded ones look from somewhere "
            "else, and their errors of poses and matches tell so"
        )
    return list(dict.fromkeys(notes))


def _differences(entries: Sequence[Figures]) -> Table:
    columns = (
        Column("first"), Column("second"), Column("figure"), Column("first - second", digits=4),
        Column("low", digits=4), Column("high", digits=4), Column("views"),
        Column("first better, share", digits=3),
    )  # fmt: skip
    keys = ("first", "second", "figure", "mean", "low", "high", "n", "first_better")
    rows = tuple(tuple(entry[key] for key in keys) for entry in entries)
    note = (
        "mean of the differences on the views that both have; low and high: its 95 % bootstrap "
        "interval over views, one figure at a time"
    )
    return Table(columns, rows, "Differences", (note,))


def _views(methods: Sequence[Figures]) -> Table:
    plain = ("name", "round", "observed")
    columns = [Column("method"), Column("view"), Column("round"), Column("observed", digits=3)]
    columns += [_column(figure) for figure in JUDGED]
    rows = [
        (method["name"], *(view[name] for name in (*plain, *JUDGED)))
        for method in methods
        for view in nested(method, "images.views") or ()
    ]
    return Table(tuple(columns), tuple(rows), "Views")


def judge_markdown(figures: Figures, tables: Mapping[str, Table], sheets: Sequence[str]) -> str:
    """The page ``judge.md``, with the contact sheets ``sheets`` beside it."""
    head = (
        f"Judged against `{figures['against']}`: {len(figures['context'])} context views, "
        f"{len(figures['targets'])} targets, {figures['with_truth']} with a true picture."
    )
    parts = ["# Judgement", head]
    shown = [tables[name] for name in ("side_by_side", "differences") if name in tables]
    parts += [markdown(table) for table in (*shown, _for_readers(tables["means"]))]
    parts += [f"![Contact sheet {number}]({name})" for number, name in enumerate(sheets, start=1)]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _for_readers(means: Table) -> Table:
    """The means without the rounds' columns and without figures that no view has."""
    columns = [i for i, c in enumerate(means.columns) if not c.title.startswith("round ")]
    at = [column.title for column in means.columns].index("mean")
    rows = [tuple(row[i] for i in columns) for row in means.rows if row[at] is not None]
    return Table(tuple(means.columns[i] for i in columns), tuple(rows), means.caption)


def print_judgement(tables: Mapping[str, Table], console: Console) -> None:
    """Print the methods side by side, and their differences in PSNR."""
    print_table(tables["side_by_side"], console)
    if "differences" in tables:
        apart = tables["differences"]
        shown: list[Sequence[Any]] = [row for row in apart.rows if str(row[2]).startswith("psnr")]
        console.table([column.heading for column in apart.columns], shown)


PAIRED = [
    f"{figure}{region}"
    for region in ("", "_valid", f"_{NEVER_OBSERVED}")
    for figure in ("psnr", "ssim", "lpips")
]


def differences(methods: Sequence[Figures], seed: int) -> list[dict[str, Any]]:
    """For each pair of methods and figure: first minus second over the views that both have."""
    out = []
    for first, second in combinations(methods, 2):
        for figure in PAIRED:
            others = {(v["name"], v["round"]): v[figure] for v in second["images"]["views"]}
            pairs = [
                (view[figure], others.get((view["name"], view["round"])))
                for view in first["images"]["views"]
            ]
            # Infinities of equal pictures are left out.
            known = [(a, b) for a, b in pairs if a is not None and b is not None]
            apart = [a - b for a, b in known if not (a == b == float("inf"))]
            if not apart:
                continue
            sign = 1 if BETTER[figure.split("_")[0]] == "higher" else -1
            out.append(
                {
                    "first": first["name"],
                    "second": second["name"],
                    "figure": figure,
                    **asdict(mean_interval(apart, seed=seed)),
                    "first_better": sum(sign * value > 0 for value in apart) / len(apart),
                }
            )
    return out
