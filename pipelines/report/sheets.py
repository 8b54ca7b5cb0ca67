"""Which of a run's targets its report shows, and the pictures of those."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gvtools.errors import GvError
from gvtools.runs.layout import COMPLETION, GUIDANCE, VALID, round_folder
from gvtools.runs.target_files import SUPPORT_SCANNED, entry_camera, read_picture
from gvtools.view_selection import nearest_views
from viz.report.contact_sheet import TargetPictures, contact_row
from viz.report.content import SheetRow, Sheets

if TYPE_CHECKING:
    from gvtools.runs.run import Run
    from gvtools.scenes.scene import Scene, View

# Decoding and compressing leave the interpreter alone.
READERS = 2
Reports = Sequence[Mapping[str, Any]]


def chosen_targets(
    reports: Reports, psnr: Mapping[str, float | None], most: int
) -> list[tuple[int, int]]:
    """(round, place in the round) of at most ``most`` targets, in order.

    Every round gives its worst target first, then its best, its second worst and so on; with more
    rounds than ``most``, rounds are taken evenly from the first to the last.

    Args:
        reports: of all rounds; round 0 has no targets.
        psnr: by the target's name, dB; where one is unknown, coverage decides.
        most: at least 1.
    """
    queues: list[list[tuple[int, int]]] = []
    for number, report in enumerate(reports):
        views = report["views"]
        known = all(psnr.get(view["name"]) is not None for view in views)
        worth = [psnr[view["name"]] if known else view["coverage"] for view in views]
        order = np.argsort(np.array(worth, np.float64), kind="stable").tolist()
        alternating = [place for ends in zip(order, reversed(order), strict=True) for place in ends]
        queues.append([(number, place) for place in alternating[: len(views)]])
    queues = [queue for queue in queues if queue]
    if len(queues) > most:
        queues = [queues[i] for i in np.unique(np.linspace(0, len(queues) - 1, most).astype(int))]
    turns = [place for turn in zip_longest(*queues) for place in turn if place is not None]
    return sorted(turns[:most])


def contact_sheets(
    run: Run,
    *,
    psnr: Mapping[str, float | None],
    most: int,
    scene: Scene | None,
    truths: Mapping[str, View | None],
) -> Sheets:
    """The pictures of some of a run's targets.

    Args:
        run: as its folder holds it.
        psnr: by the target's name, dB, where it was measured.
        most: targets to show.
        scene: the project; None where it cannot be read.
        truths: by the target's name the view that shows the truth.
    """
    path, reports = run.path, run.rounds
    places = chosen_targets(reports, psnr, most)
    total = sum(len(report["views"]) for report in reports)
    nearest = _nearest_context(scene, run.context)

    def row(place: tuple[int, int]) -> SheetRow | str:
        number, at = place
        entry = reports[number]["views"][at]
        name = str(entry["name"])
        heading = f"round {number}: {name}, coverage {entry['coverage']:.1%}"
        if psnr.get(name) is not None:
            heading += f", PSNR {psnr[name]:.2f} dB"
        try:
            pictures = _pictures(path, number, entry, truth=truths.get(name), nearest=nearest)
            return SheetRow(heading, contact_row(pictures))
        except (GvError, OSError, ValueError) as error:
            return f"pictures of {name} (round {number}) cannot be shown: {error}"

    with ThreadPoolExecutor(READERS) as pool:
        found = list(pool.map(row, places))
    rows = tuple(one for one in found if isinstance(one, SheetRow))
    folders = f"{path.resolve().name}/round_*"
    note = ""
    if total:
        note = f"{len(rows)} of {total} targets"
        if len(places) < total:
            note += (
                ": of each round its worst, then its best, and so on; the other "
                f"{total - len(rows)} lie in {folders}"
            )
        note += (
            f". Files in {folders}: guidance_* is the hint, valid_* the validity, generated_* the "
            "completion."
        )
        if not any(truths.values()):
            note += " No true pictures are at hand, so there are no error maps."
    return Sheets(rows, note, tuple(one for one in found if isinstance(one, str)))


def _pictures(
    path: Path,
    number: int,
    entry: Mapping[str, Any],
    *,
    truth: View | None,
    nearest: Callable[[Mapping[str, Any]], tuple[str, Any] | None],
) -> TargetPictures:
    folder = round_folder(path, number)
    hint, support, completion = (
        read_picture(folder, kind, entry["stem"]) for kind in (GUIDANCE, VALID, COMPLETION)
    )
    scanned = support == SUPPORT_SCANNED
    frame = None if truth is None else truth.load()
    given = nearest(entry)
    return TargetPictures(
        name=str(entry["name"]),
        hint=hint,
        observed=support >= SUPPORT_SCANNED,
        scanned=scanned if scanned.any() else None,
        supported=support > 0,
        completion=completion,
        truth=None if frame is None else frame.rgb,
        mask=None if frame is None else frame.mask,
        context=None if given is None else given[1],
        context_name="" if given is None else given[0],
    )


def _nearest_context(
    scene: Scene | None, context: Sequence[str]
) -> Callable[[Mapping[str, Any]], tuple[str, Any] | None]:
    """Finds name and picture of the context view that stands and looks most like a target."""
    if scene is None or not context:
        return lambda entry: None
    given = scene.subset(context)
    cameras = given.cameras

    @cache
    def load(place: int) -> Any:
        return given.views[place].load().rgb

    def nearest(entry: Mapping[str, Any]) -> tuple[str, Any]:
        (place,) = nearest_views(cameras, entry_camera(entry), 1)
        return given.views[place].name, load(place)

    return nearest
