"""Whether a completer is better than simple fills, asked on several kinds of scenes.

Rooms like those of training, hand-made levels, recorded depth and photographs are four domains. A
model is called better where its view mean of PSNR is above that of every baseline, with an interval
that excludes 0, in each of a domain's sets, and only if that holds on at least three domains.
Intervals resample rooms, maps, or the targets of one recorded scene; those of one scene say nothing
of other scenes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.experiments.baselines import BlendCompleter, ShrunkInpaint, fit_blend
from benchmarks.experiments.cases import SIZE, Case, held_out_cases
from benchmarks.experiments.classical import classical
from benchmarks.experiments.generated_pixels import paired_interval
from benchmarks.experiments.judging import (
    COLUMNS,
    Judged,
    difference_text,
    judge,
    perceptual,
    records,
)
from benchmarks.experiments.level_cases import level_cases
from benchmarks.experiments.options import ExperimentOptions
from benchmarks.experiments.pictures import comparison_sheet
from benchmarks.experiments.rows import geoverse
from benchmarks.experiments.scan_cases import scan_cases
from gvtools.completers.base import Completer, create
from gvtools.evaluation.tables import Column, Table
from gvtools.training.run import write_png

READS = ("weights", "scenes", "size", "seed", "projects", "levels", "pictures")

ROOMS, LEVELS = "procedural rooms", "hand-made levels"
DEPTH, PHOTOGRAPHS = "recorded depth", "photographs"
DOMAINS = (ROOMS, LEVELS, DEPTH, PHOTOGRAPHS)
SHIPPED, CANDIDATE = "geoverse", "geoverse, --weights"
# Domains on which a model has to be better.
ENOUGH = 3
# The blend is fitted to so many rooms and walks through levels, of another seed than the judged
# ones; of the same maps, where the model has seen others.
FITTED, OTHER_SEED = 50, 1000
# Rows of the sheet of pictures, and what share of a picture has to be judged to be shown.
PICTURES, LEAST_HOLE = 20, 0.03
SHOWN = ("psnr_view", "psnr", "distance_view", "energy")


@dataclass(frozen=True, eq=False)
class JudgedSet:
    """Scores on one set of cases.

    Attributes:
        name: of the set.
        domain: one of DOMAINS.
        cases: how many.
        targets: of all cases.
        judged: methods by name.
    """

    name: str
    domain: str
    cases: int
    targets: int
    judged: dict[str, Judged]


@dataclass(frozen=True)
class Verdict:
    """Where a model is better than every baseline.

    Attributes:
        model: its row.
        rivals: rows that it has to beat.
        won: domains on which it is.
        lost: domains on which it is not, each with the set and the rivals that say so.
    """

    model: str
    rivals: tuple[str, ...]
    won: tuple[str, ...]
    lost: Mapping[str, str] = field(default_factory=dict)

    @property
    def better(self) -> bool:
        """Whether the model may be called better."""
        return len(self.won) >= ENOUGH

    def __str__(self) -> str:
        judged = len(self.won) + len(self.lost)
        count = f"{len(self.won)} of {judged} domains"
        called = "better" if self.better else "NOT better"
        if judged < ENOUGH:
            called = f"unsettled (it takes {ENOUGH} domains) whether better"
        text = f"{self.model}: {called} than {', '.join(self.rivals)} a view: above all on {count}"
        text += f" ({', '.join(self.won)})" if self.won else ""
        missed = "; ".join(f"on {domain} not above {why}" for domain, why in self.lost.items())
        return f"{text}; {missed}." if missed else f"{text}."


def run(options: ExperimentOptions) -> tuple[dict[str, Any], list[Table]]:
    """Figures and tables; see ``READS``. Sets whose data are not given are left out."""
    side = options.size or SIZE
    other = options.seed + OTHER_SEED
    fitted = list(held_out_cases(FITTED, seed=other, size=side))
    if options.levels is not None:
        fitted += level_cases(options.levels, FITTED, seed=other, size=side)
    weights = fit_blend(fitted)
    baselines: dict[str, Completer] = {
        "inpaint": create("inpaint"),
        ShrunkInpaint.name: ShrunkInpaint(),
        "push-pull": classical("push-pull"),
        BlendCompleter.name: BlendCompleter(weights),
    }
    models: dict[str, Completer] = {SHIPPED: geoverse(None)}
    if options.weights is not None:
        models[CANDIDATE] = geoverse(options.weights)
    methods = models | baselines
    distance, said = perceptual()
    rng = np.random.default_rng(options.seed)
    sets, rows = [], []
    listed = list(_sources(options, side))
    for position, (name, domain, source) in enumerate(listed):
        cases = list(source)
        judged = judge(methods, cases, distance=distance, seed=options.seed)
        sets.append(JudgedSet(name, domain, len(cases), sum(len(c.rgb) for c in cases), judged))
        if options.pictures is not None:
            wanted = PICTURES // len(listed) + (position < PICTURES % len(listed))
            rows += _pictures(cases, methods, rng=rng, count=wanted, seed=options.seed)
    if options.pictures is not None:
        sheet = comparison_sheet(("guidance", *methods, "truth"), rows)
        write_png(options.pictures / "domains.png", sheet)
    verdicts = [verdict(sets, SHIPPED, tuple(baselines))]
    if options.weights is not None:
        verdicts.append(verdict(sets, CANDIDATE, (SHIPPED, *baselines)))
    found = {
        "size": side,
        "seed": options.seed,
        "perceptual_distance": said,
        "blend_weights": weights.tolist(),
        "sets": [_record(each) for each in sets],
        "verdicts": [
            {"model": v.model, "better": v.better, "won": list(v.won), "lost": dict(v.lost)}
            for v in verdicts
        ],
    }
    notes = (f"Perceptual distance: {said}.", *map(str, verdicts))
    return found, [_methods_table(sets), _differences(sets, verdicts, notes)]


def verdict(sets: list[JudgedSet], model: str, rivals: tuple[str, ...]) -> Verdict:
    """Where a model's view mean of PSNR is above that of all rivals in all sets of a domain.

    Args:
        sets: judged with the model and its rivals.
        model: a row.
        rivals: other rows.
    """
    won, lost = [], {}
    for domain in DOMAINS:
        of_domain = [each for each in sets if each.domain == domain]
        if not of_domain:
            continue
        missed = []
        for each in of_domain:
            mine = each.judged[model].scores
            equal = [
                rival
                for rival in rivals
                if not paired_interval(mine, each.judged[rival].scores, "psnr_view")[1] > 0
            ]
            if equal:
                where = (
                    "" if each.name == domain else f" on {each.name.removeprefix(domain + ': ')}"
                )
                missed.append(", ".join(equal) + where)
        if missed:
            lost[domain] = "; ".join(missed)
        else:
            won.append(domain)
    return Verdict(model, rivals, tuple(won), lost)


def _sources(options: ExperimentOptions, side: int) -> Iterator[tuple[str, str, Iterator[Case]]]:
    """Name, domain and cases of each set."""
    from gvtools.scenes.project import open_project

    yield ROOMS, ROOMS, held_out_cases(options.scenes, seed=options.seed, size=side)
    if options.levels is not None:
        cases = level_cases(options.levels, options.scenes, seed=options.seed, size=side)
        yield LEVELS, LEVELS, cases
    for path in options.projects:
        scene = open_project(path)
        domain = DEPTH if any(view.has_depth for view in scene) else PHOTOGRAPHS
        yield f"{domain}: {Path(path).name}", domain, scan_cases(scene)


def _pictures(
    cases: list[Case],
    methods: Mapping[str, Completer],
    *,
    rng: np.random.Generator,
    count: int,
    seed: int,
) -> list[list[np.ndarray]]:
    """Rows of random views that have something to judge: guidance, completions, truth."""
    views = [
        (case, index)
        for case in cases
        for index in range(len(case.rgb))
        if case.generated[index].mean() > LEAST_HOLE
    ]
    rows = []
    for place in rng.permutation(len(views))[:count]:
        case, index = views[place]
        made = [
            method.complete(case.context, case.guidance, seed=seed).rgb[index]
            for method in methods.values()
        ]
        rows.append([case.guidance.rgb[index], *made, case.rgb[index]])
    return rows


def _record(each: JudgedSet) -> dict[str, Any]:
    return {
        "set": each.name,
        "domain": each.domain,
        "cases": each.cases,
        "targets": each.targets,
        "results": records(each.judged, against=dict.fromkeys(COLUMNS, SHIPPED)),
    }


def _methods_table(sets: list[JudgedSet]) -> Table:
    columns = (
        Column("set"),
        Column("method"),
        *COLUMNS.values(),
        Column("seconds", "a view", "lower", 3),
    )
    rows = []
    for each in sets:
        for name, entry in each.judged.items():
            figures = entry.row()
            rows.append((each.name, name, *(figures[k] for k in (*COLUMNS, "seconds"))))
    targets = "; ".join(f"{e.name}: {e.targets} targets of {e.cases} cases" for e in sets)
    return Table(columns, tuple(rows), f"Generated pixels. {targets}")


def _differences(sets: list[JudgedSet], verdicts: list[Verdict], notes: tuple[str, ...]) -> Table:
    shown = (Column(f"{COLUMNS[k].title}, {COLUMNS[k].unit.split(', ')[-1]}") for k in SHOWN)
    rows = tuple(
        (
            each.name,
            v.model,
            rival,
            *(difference_text(each.judged[v.model], each.judged[rival], k) for k in SHOWN),
        )
        for each in sets
        for v in verdicts
        for rival in v.rivals
    )
    caption = "Differences, 95 % of the paired bootstrap over rooms, maps, or one scene's targets"
    return Table((Column("set"), Column("model"), Column("against"), *shown), rows, caption, notes)
