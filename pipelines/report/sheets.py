"""Which of a run's targets its report shows, and the pictures of those."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gvtools.errors import GvError
from gvtools.runs.folder import RunDirectory
from gvtools.runs.round_files import SUPPORT_OBSERVED, read_png
from viz.report.contact_sheet import TargetPictures, contact_row
from viz.report.content import SheetRow
from viz.run_view.view import inside

if TYPE_CHECKING:
    from gvtools.cameras import Cameras
    from gvtools.scenes.scene import Scene, View

# Decoding and compressing leave the interpreter alone.
READERS = 2
Reports = Sequence[Mapping[str, Any]]


@dataclass(frozen=True, eq=False)
class Sheets:
    """What was found to show.

    Attributes:
        rows: a target each.
        note: which targets they are, and where the others lie.
        warnings: pictures that could not be read.
    """

    rows: tuple[SheetRow, ...]
    note: str
    warnings: tuple[str, ...]


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
        order = [int(place) for place in np.argsort(np.array(worth, np.float64), kind="stable")]
        queue: list[tuple[int, int]] = []
        while order:
            queue.append((number, order.pop(0 if len(queue) % 2 == 0 else -1)))
        if queue:
            queues.append(queue)
    if len(queues) > most:
        queues = [queues[i] for i in np.unique(np.linspace(0, len(queues) - 1, most).astype(int))]
    out: list[tuple[int, int]] = []
    while any(queues) and len(out) < most:
        for queue in queues:
            if queue and len(out) < most:
                out.append(queue.pop(0))
    return sorted(out)


def contact_sheets(
    path: Path,
    reports: Reports,
    *,
    psnr: Mapping[str, float | None],
    most: int,
    scene: Scene | None,
    context: Sequence[str],
    truths: Mapping[str, View | None],
) -> Sheets:
    """The pictures of some of a run's targets.

    Args:
        path: the run's folder.
        reports: of its rounds.
        psnr: by the target's name, dB, where it was measured.
        most: targets to show.
        scene: the project; None where it cannot be read.
        context: names of the given views.
        truths: by the target's name the view that shows the truth.
    """
    places = chosen_targets(reports, psnr, most)
    total = sum(len(report["views"]) for report in reports)
    nearest = _nearest_context(scene, context)

    def row(place: tuple[int, int]) -> SheetRow | str:
        number, at = place
        entry = reports[number]["views"][at]
        name = str(entry["name"])
        heading = f"round {number}: {name}, coverage {entry['coverage']:.1%}"
        if psnr.get(name) is not None:
            heading += f", PSNR {psnr[name]:.2f} dB"
        try:
            pictures = _pictures(path, number, entry, truths.get(name), nearest)
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
    truth: View | None,
    nearest: Callable[[Mapping[str, Any]], tuple[str, Any] | None],
) -> TargetPictures:
    folder = RunDirectory(path).round_path(number)
    hint, support, completion = (
        read_png(inside(path, folder / f"{kind}_{entry['stem']}.png"))
        for kind in ("guidance", "valid", "generated")
    )
    size = completion.shape[:2]
    if hint.shape != (*size, 3) or completion.shape != (*size, 3) or support.shape != size:
        raise ValueError(
            f"guidance {hint.shape}, completion {completion.shape}, validity {support.shape}; "
            "expected colour, colour and grey of one size"
        )
    frame = None if truth is None else truth.load()
    if frame is not None and frame.rgb.shape != completion.shape:
        raise ValueError(
            f"its photograph is {frame.rgb.shape[1]}x{frame.rgb.shape[0]} now, the completion "
            f"{completion.shape[1]}x{completion.shape[0]}"
        )
    given = nearest(entry["camera"])
    return TargetPictures(
        name=str(entry["name"]),
        hint=hint,
        observed=support == SUPPORT_OBSERVED,
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
    """Finds name and picture of the context view that stands and looks most like a camera."""
    if scene is None or not context:
        return lambda camera: None
    given = scene.subset(context)
    cameras = given.cameras

    @cache
    def load(place: int) -> Any:
        return given.views[place].load().rgb

    def nearest(camera: Mapping[str, Any]) -> tuple[str, Any]:
        place = nearest_camera(cameras, np.array(camera["cam_from_world"], np.float64))
        return given.views[place].name, load(place)

    return nearest


def nearest_camera(cameras: Cameras, cam_from_world: np.ndarray) -> int:
    """The row of the camera nearest to a pose: in centre, by the cameras' extent, and in angle.

    Args:
        cameras: at least one.
        cam_from_world: (4, 4).
    """
    centre = -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]
    extent = float(np.ptp(np.vstack([cameras.centers, centre]), axis=0).max()) or 1.0
    apart = np.linalg.norm(cameras.centers - centre, axis=1) / extent
    cosine = cameras.cam_from_world[:, 2, :3] @ cam_from_world[2, :3]
    angle = np.arccos(np.clip(cosine, -1, 1)) / (np.pi / 2)
    return int(np.argmin(apart + angle))
