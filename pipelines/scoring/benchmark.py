"""Whole benchmarks: a cell for every scene, number of views and method, each measured by itself.

A process of its own tells a cell's peak memory, and one that the system ends for want of memory
leaves the others to go on. It ends with the command that began it, however that ends.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import gvtools
from gvtools.errors import GvError, OptionError, ProjectError
from gvtools.evaluation.images import Lpips
from gvtools.evaluation.published import Benchmark, SceneSplit, Setting, load_benchmark
from gvtools.files import digest, make_folder, write_json
from gvtools.untrusted import read_json
from pipelines.console import Console, Silent
from pipelines.machine import process_peak_bytes
from pipelines.scoring.benchmark_scenes import (
    at_benchmark_size,
    masked_figures,
    object_mask,
    open_benchmark_scene,
    picture_size,
    pictures_folder,
    reading_of,
    split_of_scene,
    write_thumbnails,
)

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene
    from pipelines.reconstruction.settings import RunSettings
    from pipelines.scoring.measurement import MeasureOptions

Record = dict[str, Any]
MEASURED, FAILED = "measured", "failed"
DEFAULT = "default"
# Settings of the paper's protocol, and of its ablation "w/o spatial memory".
PAPER: Mapping[str, Mapping[str, Any]] = {
    "paper": {"protocol": "paper"},
    "paper-without-memory": {"protocol": "paper", "completer.memory": False},
}
# Names become names of files.
_NAME = re.compile(r"\w[\w+. -]*")
# Figures of poses and of consistency between views; the others compare pictures with their truth.
BEYOND_PICTURES = {"ate", "rpe_r", "rpe_t", "reproj", "met3r"}


@dataclass(frozen=True, kw_only=True)
class Method:
    """One method: settings of gvtools, or pictures that something else made."""

    name: str  # in tables and names of files
    settings: Mapping[str, Any] = field(default_factory=dict)  # of a run, by dotted name
    pictures: Path | None = None  # the folder of another method's; None where gvtools makes them

    def config(self, *, seconds: float | None) -> RunSettings:
        """The settings of its runs; Gaussians, if it fits any, are fitted for so many seconds."""
        from gvtools.settings import with_values
        from pipelines.reconstruction.settings import RunSettings

        config = with_values(RunSettings(), self.settings)
        if seconds is not None and config.refine.wanted:
            config = with_values(config, {"refine.seconds": seconds})
        return config


def parse_methods(text: str) -> tuple[Method, ...]:
    """Methods with commas between them.

    Each is ``default``, a profile, a completer, ``paper`` (its protocol), ``paper-without-memory``
    (its ablation), ``NAME=FILE.json`` (a file of settings) or ``NAME=DIR`` (pictures of another
    method).
    """
    methods = tuple(_parsed(part.strip()) for part in text.split(",") if part.strip())
    names = [method.name for method in methods]
    if not methods or len(set(names)) < len(names):
        raise OptionError(f"--methods {text!r}; expected at least one, each name once")
    return methods


def _parsed(text: str) -> Method:
    from gvtools.completers.base import available
    from gvtools.settings import changes, with_file
    from gvtools.specs import unknown
    from pipelines.reconstruction.settings import RunSettings

    name, equals, place = (part.strip() for part in text.partition("="))
    if not equals:
        known: dict[str, Mapping[str, Any]] = {DEFAULT: {}, **PAPER}
        known |= {profile: {"profile": profile} for profile in RunSettings.presets["profile"]}
        known |= {completer: {"completer": completer} for completer in available()}
        if name not in known:
            raise OptionError(f"{unknown('method', name, known)}; NAME=DIR gives pictures")
        return Method(name=name, settings=known[name])
    if not _NAME.fullmatch(name):
        raise OptionError(
            f"method {name!r}; expected letters, digits, blanks and + . - _, the first a letter or "
            "a digit"
        )
    path = Path(place).expanduser()
    if path.is_dir():
        return Method(name=name, pictures=path.resolve())
    if path.suffix != ".json" or not path.is_file():
        raise OptionError(
            f"method {name}={path}: expected a folder of pictures or a JSON file of settings"
        )
    return Method(name=name, settings=changes(RunSettings(), with_file(RunSettings(), path)))


@dataclass(frozen=True, kw_only=True)
class BenchmarkCell:
    """What is measured, and where its results lie."""

    benchmark: str  # name of a file in data_specs/benchmarks
    root: Path  # folder of the data set, or of the projects
    scene: str
    views: int  # how many are given
    method: Method
    seconds: float | None  # for fitting the appearance; None leaves it to the method
    lpips: tuple[str, Path | None] | None  # network and folder of its weights; None leaves it out
    out: Path  # of all results

    @property
    def stem(self) -> Path:
        """Scene, number of views and method, as a relative path."""
        return Path(self.scene.replace("/", "__"), f"{self.views}_views", self.method.name)

    @property
    def result(self) -> Path:
        """The JSON file of the figures."""
        return (self.out / "cells" / self.stem).with_name(f"{self.method.name}.json")

    @property
    def run(self) -> Path:
        """The folder of the run; for pictures made elsewhere, of the memory of their context."""
        return self.out / "runs" / self.stem

    @property
    def identity(self) -> dict[str, Any]:
        """What decides its figures, JSON-ready."""
        spec = load_benchmark(self.benchmark).model_dump_json(include={"splits", "resolution"})
        return {
            "benchmark": self.benchmark,
            "protocol": digest(spec),
            "root": str(self.root),
            "settings": json.loads(json.dumps(dict(self.method.settings), default=str)),
            "pictures": None if self.method.pictures is None else str(self.method.pictures),
            "seconds": self.seconds,
            "lpips": None if self.lpips is None else self.lpips[0],
            "version": gvtools.__version__,
        }


@dataclass(frozen=True, eq=False)
class _OpenCell:
    """A cell with its opened scene."""

    cell: BenchmarkCell
    benchmark: Benchmark  # with the cell's number of context views
    scene: Scene  # at the benchmark's picture size
    split: SceneSplit
    size: tuple[int, int] | None  # that picture size (width, height), where the benchmark sets one
    reading: dict[str, Any]  # options by which later commands open the run's scene as it was here
    lpips: Lpips | None

    @property
    def options(self) -> MeasureOptions:
        """The measures that the benchmark's figures need."""
        from pipelines.scoring.measurement import PARTS, MeasureOptions

        parts = PARTS if BEYOND_PICTURES & set(self.benchmark.figures) else ("images",)
        return MeasureOptions(parts=parts, lpips=self.lpips, control=False)

    @property
    def views(self) -> dict[str, str]:
        """The context and the targets, as settings of a run name them."""
        return {"context": ",".join(self.split.context), "targets": ",".join(self.split.targets)}


def measure_cell(cell: BenchmarkCell) -> dict[str, Any]:
    """Make the pictures of a cell, unless the method is a folder of pictures, and measure them."""
    benchmark = load_benchmark(cell.benchmark).at(cell.views)
    recorded = open_benchmark_scene(benchmark, cell.scene, cell.root)
    split = split_of_scene(benchmark, recorded)
    size = picture_size(benchmark, recorded)
    scene = at_benchmark_size(recorded, split, size=size)
    lpips = None if cell.lpips is None else Lpips(cell.lpips[0], folder=cell.lpips[1])
    opened = _OpenCell(cell, benchmark, scene, split, size, reading_of(recorded, size), lpips)
    measure = _of_run if cell.method.pictures is None else _of_pictures
    measured, pictures = measure(opened)
    masks = {
        name: object_mask(benchmark, cell.root, scene=cell.scene, index=recorded.names.index(name),
                          shape=picture.shape[:2])
        for name, picture in pictures.items()
    }  # fmt: skip
    measured["figures"] |= masked_figures(pictures, scene, masks, lpips=lpips)
    write_thumbnails(cell.result, pictures, scene, context=split.context)
    sizes = {picture.shape[:2] for picture in pictures.values()}
    return {
        "split": {"context": list(split.context), "rounds": [list(r) for r in split.rounds]},
        "resolution": [*sizes.pop()][::-1] if len(sizes) == 1 else None,
        "masked": bool(masks) and all(mask is not None for mask in masks.values()),
        **measured,
    }


def _of_run(opened: _OpenCell) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Run gvtools; its figures and cost, and its pictures (H, W, 3) uint8 by target."""
    from gvtools.runs.run import load_run
    from pipelines.scoring.evaluation import evaluate_run

    seconds = _reconstruct(opened)
    peak = process_peak_bytes()
    run = load_run(opened.cell.run)
    figures = evaluate_run(run, opened.options, console=Silent())
    pictures = {target.name: files.picture for target, files, _ in run.targets()}
    return {
        **_summary(figures),
        "seconds": seconds,
        "peak_bytes": peak,
        "gpu_bytes": _gpu_bytes(),
    }, pictures


def _reconstruct(opened: _OpenCell) -> float:
    """Run the method; returns the seconds from the opened scene to the finished run."""
    from gvtools.settings import with_values
    from pipelines.reconstruction.run import compile_kernels, reconstruct
    from pipelines.reconstruction.settings import RunSettings
    from pipelines.report import draw_run

    cell, benchmark = opened.cell, opened.benchmark
    # All methods work at the benchmark's size, also profiles that would reduce pictures further.
    side = RunSettings().max_side if opened.size is None else None
    decided: dict[str, Any] = {**opened.views, "seed": 0, "max_side": side}
    if benchmark.targets is not None:
        decided |= {"views_per_round": benchmark.targets, "rounds": benchmark.rounds}
    config = with_values(cell.method.config(seconds=cell.seconds), decided)
    # A killed run is started from scratch, so that the seconds are those of a whole run.
    shutil.rmtree(cell.run, ignore_errors=True)
    make_folder(cell.run.parent)
    compile_kernels(config, Silent())
    start = time.perf_counter()
    reconstruct(
        opened.scene, config, cell.run, console=Silent(), reading=opened.reading, draw=draw_run
    )
    return time.perf_counter() - start


def _of_pictures(opened: _OpenCell) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Figures of pictures in a folder, as ``gvtools judge`` has them, and these by target."""
    from gvtools.runs.digests import versions
    from pipelines.scoring.judging import open_method, reference_from_context
    from pipelines.scoring.measurement import Measurement

    cell = opened.cell
    assert cell.method.pictures is not None
    make_folder(cell.run.parent)
    reference = reference_from_context(
        opened.scene,
        cell.run,
        **opened.views,
        cameras=None,
        reading=opened.reading,
        console=Silent(),
    )
    folder = pictures_folder(cell.method.pictures, cell.scene, views=cell.views)
    method = open_method(folder, cell.method.name, reference.targets, rule="auto")
    if method.matching.missing:
        raise ProjectError(
            f"{folder}: no picture of {len(method.matching.missing)} of {len(reference.targets)} "
            f"targets, first {method.matching.missing[0]}; expected all"
        )
    if method.resized:
        (width, height), *_ = method.resized
        raise ProjectError(
            f"{folder}: pictures of {width}x{height} pixels; expected the benchmark's size, that "
            "of their targets"
        )
    measured = Measurement(
        options=opened.options, context=reference.context, truths=[], console=Silent()
    ).of(reference.with_surfaces(method.targets))
    evaluation = {**measured, "coverage": None, "versions": versions()}
    pictures = {target.picture.name: target.picture.rgb for target in method.targets}
    return _summary(evaluation), pictures


def _summary(evaluation: Mapping[str, Any]) -> dict[str, Any]:
    """What tables show of an evaluation, as ``gvtools evaluate`` has it."""
    from pipelines.report import nested
    from pipelines.scoring.tables import measured_row, scalars

    nothing = Setting(data_set=None, resolution=None, context=None, targets=None)
    figures = dict(measured_row("", [evaluation], nothing).figures)
    figures["psnr_observed"] = nested(evaluation, "images.mean.psnr_valid.mean")
    figures["coverage"] = evaluation["coverage"]
    figures |= {label: value for label, value, *_ in scalars(evaluation)}
    poses = evaluation.get("poses", {})
    found = None
    if nested(poses, "pictures"):
        found = f"pose probe ({poses['matcher']}), {poses['located']} of {poses['pictures']} views"
    return {
        "figures": figures,
        "views": evaluation["images"]["views"],
        "poses_from": found,
        "met3r": nested(evaluation, "consistency.generated.met3r.status"),
        "versions": evaluation["versions"],
        "masked_share": evaluation["images"]["settings"]["masked_share"],
        "notes": evaluation["images"]["notes"],
    }


def _gpu_bytes() -> int | None:
    """Peak memory that torch allocated on the CUDA device, bytes; None where none was used."""
    import sys

    torch = sys.modules.get("torch")
    if torch is None or not torch.cuda.is_available():
        return None
    return int(torch.cuda.max_memory_allocated()) or None


def read_cell(cell: BenchmarkCell) -> Record | None:
    """What a cell's file holds; None where there is none, or a damaged one."""
    try:
        found = read_json(cell.result)
        before = found["identity"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    now = cell.identity
    key = next((key for key, value in now.items() if before.get(key) != value), None)
    if key is not None:
        raise OptionError(
            f"{cell.result}: measured with {key} {before.get(key)!r}, now {now[key]!r}; give the "
            "same, or another --out"
        )
    return dict(found)


def measure_cells(
    cells: Sequence[BenchmarkCell],
    *,
    console: Console,
    measure: Callable[[BenchmarkCell], None],
    after: Callable[[], None],
) -> None:
    """Measure those that are not measured yet; what fails leaves its reason, and is tried again.

    ``measure`` writes a cell's file, ``after`` is called behind each. Pictures of other methods are
    always measured: they may have changed, and it takes no time.
    """
    records = [read_cell(cell) for cell in cells]
    for number, (cell, record) in enumerate(zip(cells, records, strict=True), start=1):
        head = f"[{number}/{len(cells)}] {cell.scene}, {cell.views} views, {cell.method.name}"
        if record and record["status"] == MEASURED and cell.method.pictures is None:
            console.line(f"{head}: measured before, {_summary_line(record)}")
            continue
        console.line(head)
        measure(cell)
        record = read_cell(cell) or {"status": FAILED, "reason": "left no result"}
        if record["status"] == FAILED:
            console.warn(f"{head}: failed: {record['reason']}")
        else:
            console.line(f"{head}: {_summary_line(record)}")
        after()


def _summary_line(result: Mapping[str, Any]) -> str:
    """A cell's accuracy and cost, in words."""
    psnr, seconds, peak = result["figures"]["psnr"], result.get("seconds"), result.get("peak_bytes")
    words = ["no PSNR" if psnr is None else f"{psnr:.2f} dB"]
    words += [] if seconds is None else [f"{seconds:.1f} s"]
    words += [] if peak is None else [f"{peak / 2**20:.0f} MiB"]
    return ", ".join(words)


def measure_and_write(cell: BenchmarkCell) -> None:
    """Measure a cell in this process and write its file, with the reason where that fails."""
    try:
        _write(cell, {"status": MEASURED, **measure_cell(cell)})
    except GvError as error:
        _write(cell, {"status": FAILED, "reason": str(error)})
    except Exception as error:
        reason = f"unexpected {type(error).__name__}: {error}"
        trace = traceback.format_exc()
        _write(cell, {"status": FAILED, "reason": reason, "trace": trace})


def _write(cell: BenchmarkCell, record: Record) -> None:
    head = {"identity": cell.identity, "scene": cell.scene, "views_given": cell.views,
            "method": cell.method.name}  # fmt: skip
    write_json(cell.result, {**head, **record})


def measure_apart(cell: BenchmarkCell) -> None:
    """Measure a cell in a process of its own."""
    import multiprocessing

    # Of a kill, nothing is left but what stood there before.
    cell.result.unlink(missing_ok=True)
    process = multiprocessing.get_context("spawn").Process(target=_child, args=(cell,))
    process.start()
    try:
        process.join()
    except BaseException:
        process.kill()
        raise
    if not cell.result.is_file():
        reason = f"its process ended with exit status {process.exitcode}"
        if process.exitcode == -9:
            reason = "its process was killed; the system does that when memory runs out"
        _write(cell, {"status": FAILED, "reason": reason})


def _child(cell: BenchmarkCell) -> None:
    import signal
    import threading

    # A terminal interrupts this process, too; the command's own ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    measure_and_write(cell)


def _end_with_parent() -> None:
    """End this process when the command that began it is gone, even when that was killed."""
    import multiprocessing
    from multiprocessing.connection import wait

    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
