"""Several methods' pictures measured on the same targets, with tables and contact sheets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.evaluation.tables import csv_text
from gvtools.files import replaced_when_written, write_json, write_text
from pipelines.scoring.evaluation import provenance
from pipelines.scoring.measurement import (
    JUDGED,
    MeasuredTarget,
    Measurement,
    MeasureOptions,
    evenly,
    matcher_called,
    true_pictures,
)
from pipelines.scoring.method_pictures import JudgeReference, MethodPictures, open_method
from pipelines.scoring.sweep import Record, records_of
from pipelines.scoring.tables import differences, judge_markdown, judge_tables, print_judgement
from viz.report.pictures import JudgedView, method_sheet

if TYPE_CHECKING:
    from gvtools.evaluation.tables import Table
    from pipelines.console import Console

VIEWS_A_SHEET = 4


def judge(
    paths: Sequence[Path],
    names: Sequence[str],
    reference: JudgeReference,
    *,
    options: MeasureOptions,
    rule: str,
    sheet_views: int,
    out: Path,
    console: Console,
) -> dict[str, Any]:
    """Measure the methods, write figures, tables and sheets, print the table.

    Pictures are matched with views by a rule of ``match_pictures``. The figures are what
    ``judge.json`` holds.
    """
    targets = reference.targets
    measurement = Measurement(
        options=options,
        context=reference.context,
        truths=true_pictures(targets),
        names=JUDGED,
        console=console,
        matcher=matcher_called(options.matcher),
    )
    shown = {targets[row].key: targets[row] for row in evenly(len(targets), sheet_views)}
    on_sheets: dict[str, dict[tuple[str, int], NDArray[np.uint8]]] = {}

    def measure(given: tuple[Path, str]) -> Record:
        path, name = given
        method = open_method(path, name, targets, rule=rule, others=reference.others)
        if "consistency" in options.parts:
            # Pictures without depth get the memory's.
            method = replace(method, targets=reference.with_surfaces(method.targets))
        _print_matching(method, len(targets), console)
        on_sheets[name] = {t.key: t.picture.rgb for t in method.targets if t.key in shown}
        return {
            **method.to_dict(),
            "rounds": max((target.number for target in method.targets), default=0),
            "views": len(method.targets),
            **measurement.of(method.targets),
        }

    measured = records_of(zip(paths, names, strict=True), measure)
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
            "parts": list(options.parts),
            "matcher": options.matcher,
            "control": options.control,
            "rule": rule,
            "sheet_views": sheet_views,
            "seed": options.seed,
            "lpips_net": options.lpips_net,
            "lpips_measured": options.lpips is not None,
            **provenance(),
        },
    }
    tables = judge_tables(figures)
    files = _write(figures, tables, _judged_views(shown, on_sheets), out=out)
    print_judgement(tables, console)
    console.line(
        f"results in {out}: judge.json, judge.md, judge.csv, "
        f"{', '.join(f'{name}.csv' for name in tables if name != 'means')}"
        + (f", {len(files)} contact sheets" if files else "")
    )
    return figures


def _print_matching(method: MethodPictures, targets: int, console: Console) -> None:
    """Say how the pictures were read and matched."""
    name, matching, pictures = method.name, method.matching, method.pictures
    console.line(
        f"{name}: {len(method.targets)} of {targets} views, matched by "
        f"{matching.rule} ({pictures.layout})"
    )
    for note in pictures.notes:
        console.line(f"  {note}")
    if matching.missing:
        listed = ", ".join(matching.missing[:3]) + (", ..." if len(matching.missing) > 3 else "")
        console.warn(f"{name}: no picture of {len(matching.missing)} views ({listed})")
    if matching.left_over:
        console.line(f"  {len(matching.left_over)} pictures of no judged view left out")
    if method.doubt:
        console.warn(f"{name}: {method.doubt}")
    for (width, height), count in sorted(method.resized.items()):
        console.warn(f"{name}: {count} pictures of {width}x{height} pixels resized to their views'")


def _judged_views(
    shown: Mapping[tuple[str, int], MeasuredTarget],
    pictures: Mapping[str, Mapping[tuple[str, int], NDArray[np.uint8]]],
) -> list[JudgedView]:
    """The views of the contact sheets, each with its picture of every method that has one."""
    return [
        JudgedView(
            name=target.picture.name,
            truth=None if target.truth is None else target.truth.rgb,
            mask=None if target.truth is None else target.truth.mask,
            never_observed=~target.observed,
            pictures={name: own.get(key) for name, own in pictures.items()},
        )
        for key, target in shown.items()
    ]


def _write(
    figures: dict[str, Any], tables: Mapping[str, Table], views: Sequence[JudgedView], *, out: Path
) -> list[str]:
    """Write the results; returns the names of the contact sheets."""
    from PIL import Image

    sheets = []
    for number, first in enumerate(range(0, len(views), VIEWS_A_SHEET)):
        sheets.append(f"sheet_{number:03d}.png")
        picture = Image.fromarray(method_sheet(views[first : first + VIEWS_A_SHEET]))
        with replaced_when_written(out / sheets[-1]) as temporary:
            picture.save(temporary, format="PNG")
    write_json(out / "judge.json", figures)
    for name, table in tables.items():
        write_text(out / ("judge.csv" if name == "means" else f"{name}.csv"), csv_text(table))
    write_text(out / "judge.md", judge_markdown(figures, tables, sheets))
    return sheets
