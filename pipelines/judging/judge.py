"""Several methods' pictures measured on the same targets, and what is written of it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.evaluation.intervals import LEVEL, RESAMPLES
from gvtools.evaluation.tables import csv_text
from gvtools.files import write_json, write_text
from gvtools.runs.identity import versions
from pipelines.evaluation.measured_target import true_pictures
from pipelines.evaluation.measurement import Measurement
from pipelines.evaluation.picture_figures import JUDGED
from pipelines.judging.differences import differences
from pipelines.judging.methods import Method, open_method
from pipelines.judging.sheets import SheetPictures, write_sheets
from pipelines.judging.tables import judge_markdown, judge_tables, printed

if TYPE_CHECKING:
    from gvtools.evaluation.lpips_distance import Lpips
    from pipelines.console import Console
    from pipelines.judging.reference import Reference


@dataclass(frozen=True, kw_only=True)
class JudgeOptions:
    """What is measured, and how.

    Attributes:
        parts: of measurement.PARTS.
        matcher: of the pose probe, "sift" or "lightglue".
        control: measure the true pictures as well.
        rule: how pictures are matched with views, see ``match_pictures``.
        sheet_views: views on the contact sheets; 0 writes none.
        seed: of resampling, matching and robust estimates.
        lpips_net: backbone of LPIPS.
    """

    parts: tuple[str, ...]
    matcher: str
    control: bool
    rule: str
    sheet_views: int
    seed: int
    lpips_net: str


def judge(
    paths: Sequence[Path],
    names: Sequence[str],
    reference: Reference,
    *,
    options: JudgeOptions,
    lpips: Lpips | None,
    no_lpips: str | None,
    out: Path,
    console: Console,
) -> dict[str, Any]:
    """Measure the methods, write figures, tables and sheets, print the table.

    Args:
        paths: of the methods' pictures.
        names: of the methods.
        reference: what they are judged against.
        options: what to measure.
        lpips: the network, or None.
        no_lpips: why there is none.
        out: folder for the results.
        console: for progress and the table.

    Returns:
        What ``judge.json`` holds.
    """
    targets = reference.targets
    measurement = Measurement(
        parts=options.parts,
        context=reference.context,
        truths=true_pictures(targets),
        lpips=lpips,
        no_lpips=no_lpips,
        matcher=_matcher(options.matcher),
        control=options.control,
        names=JUDGED,
        seed=options.seed,
        console=console,
    )
    sheets = SheetPictures(targets, options.sheet_views)
    measured = []
    for path, name in zip(paths, names, strict=True):
        method = _opened(path, name, reference, options=options, console=console)
        sheets.add(method)
        measured.append(_measured(method, measurement))
    figures = {
        "against": str(reference.run.path),
        "project": reference.run.record["project"],
        "context": list(reference.run.context),
        "poses": reference.poses,
        "cameras": None if reference.cameras is None else str(reference.cameras),
        "targets": [target.picture.name for target in targets],
        "with_truth": sum(target.truth is not None for target in targets),
        "methods": measured,
        "differences": differences(measured, options.seed) if "images" in options.parts else [],
        "judge": {
            **asdict(options),
            "lpips_measured": lpips is not None,
            "bootstrap": {"level": LEVEL, "resamples": RESAMPLES},
            "versions": versions(),
            "date": time.strftime("%Y-%m-%d", time.gmtime()),
        },
    }
    _write(figures, sheets, out, console=console)
    return figures


def _opened(
    path: Path, name: str, reference: Reference, *, options: JudgeOptions, console: Console
) -> Method:
    """The method's pictures; those without depth get the memory's, where it is needed."""
    method = open_method(path, name, reference.targets, rule=options.rule)
    if "consistency" in options.parts:
        method = replace(
            method,
            targets=[
                reference.with_surface(target) if target.picture.depth is None else target
                for target in method.targets
            ],
        )
    matching, pictures = method.matching, method.pictures
    console.line(
        f"{name}: {len(method.targets)} of {len(reference.targets)} views, matched by "
        f"{matching.rule} ({pictures.layout})"
    )
    for note in pictures.notes:
        console.line(f"  {note}")
    if matching.missing:
        listed = ", ".join(matching.missing[:3]) + (", ..." if len(matching.missing) > 3 else "")
        console.warn(f"{name}: no picture of {len(matching.missing)} views ({listed})")
    if matching.left_over:
        console.line(f"  {len(matching.left_over)} pictures of no judged view left out")
    for (width, height), count in sorted(method.resized.items()):
        console.warn(f"{name}: {count} pictures of {width}x{height} pixels resized to their views'")
    return method


def _measured(method: Method, measurement: Measurement) -> dict[str, Any]:
    described = method.described()
    if described["depth"] is None and any(t.surface is not None for t in method.targets):
        described["depth"] = "none; features are carried by the memory's"
    numbers = {target.number for target in method.targets}
    return {
        **described,
        "rounds": max(numbers, default=0),
        "views": len(method.targets),
        **measurement.of(method.targets),
    }


def _write(figures: dict[str, Any], sheets: SheetPictures, out: Path, *, console: Console) -> None:
    tables = judge_tables(figures)
    files = write_sheets(sheets, out)
    write_json(out / "judge.json", figures)
    for name, table in tables.items():
        write_text(out / ("judge.csv" if name == "means" else f"{name}.csv"), csv_text(table))
    write_text(out / "judge.md", judge_markdown(figures, tables, [file.name for file in files]))
    printed(tables, console)
    console.line(
        f"results in {out}: judge.json, judge.md, judge.csv, "
        f"{', '.join(f'{name}.csv' for name in tables if name != 'means')}"
        + (f", {len(files)} contact sheets" if files else "")
    )


def _matcher(name: str) -> Any:
    if name == "sift":
        return None
    from gvtools.features import LightGlueMatcher

    return LightGlueMatcher()
