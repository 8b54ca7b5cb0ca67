"""One cell of a benchmark: a scene, a number of views, a method; its pictures and its figures."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gvtools.errors import ProjectError
from gvtools.evaluation.published import Benchmark, load_benchmark
from gvtools.files import make_folder
from pipelines.benchmark.methods import Method
from pipelines.benchmark.pictures import (
    masked_figures,
    object_mask,
    pictures_folder,
    write_thumbnails,
)
from pipelines.benchmark.scenes import (
    open_benchmark_scene,
    picture_size,
    prepared,
    reading_of,
    split_of_scene,
)
from pipelines.console import Console

if TYPE_CHECKING:
    from gvtools.evaluation.lpips_distance import Lpips
    from gvtools.evaluation.splits import SceneSplit
    from gvtools.scenes.scene import Scene

# Figures of poses and of consistency between views; the others compare pictures with their truth.
BEYOND_PICTURES = {"ate", "rpe_r", "rpe_t", "reproj", "met3r"}


@dataclass(frozen=True, kw_only=True)
class Cell:
    """What is measured, and where it is kept.

    Attributes:
        benchmark: its name, that of a file in data_specs/benchmarks.
        root: folder of the data set, or of the projects.
        scene: its name.
        views: number of context views.
        method: what makes the pictures.
        seconds: time for fitting the appearance; None leaves it to the method.
        lpips: network of LPIPS and the folder of its weights; None where it is not measured.
        out: folder of the benchmark's results.
    """

    benchmark: str
    root: Path
    scene: str
    views: int
    method: Method
    seconds: float | None
    lpips: tuple[str, Path | None] | None
    out: Path

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


@dataclass(frozen=True, eq=False)
class _Task:
    """A cell with its opened scene.

    Attributes:
        cell: what is measured.
        benchmark: with the cell's number of context views.
        scene: at the benchmark's picture size.
        split: its context and target views.
        size: that picture size (width, height); None where the benchmark sets none.
        reading: options by which later commands open the run's scene as it was here.
        lpips: the network; None leaves LPIPS out.
    """

    cell: Cell
    benchmark: Benchmark
    scene: Scene
    split: SceneSplit
    size: tuple[int, int] | None
    reading: dict[str, Any]
    lpips: Lpips | None

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts of ``gvtools evaluate`` that the benchmark's figures need."""
        from pipelines.evaluation.measurement import PARTS

        return PARTS if BEYOND_PICTURES & set(self.benchmark.figures) else ("images",)

    @property
    def views(self) -> dict[str, str]:
        """The context and the targets, as settings of a run name them."""
        return {"context": ",".join(self.split.context), "targets": ",".join(self.split.targets)}


def measure_cell(cell: Cell) -> dict[str, Any]:
    """Make the pictures of a cell, unless the method is a folder of pictures, and measure them.

    Returns:
        Figures and what they were measured on, JSON-ready.
    """
    from gvtools.evaluation.lpips_distance import Lpips

    benchmark = load_benchmark(cell.benchmark).at(cell.views)
    recorded = open_benchmark_scene(benchmark, cell.scene, cell.root)
    split = split_of_scene(benchmark, recorded)
    size = picture_size(benchmark, recorded)
    scene = prepared(recorded, split, size=size)
    lpips = None if cell.lpips is None else Lpips(cell.lpips[0], folder=cell.lpips[1])
    task = _Task(cell, benchmark, scene, split, size, reading_of(recorded, size), lpips)
    measure = _of_run if cell.method.pictures is None else _of_pictures
    measured, pictures = measure(task)
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


def _of_run(task: _Task) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Run gvtools; its figures and cost, and its pictures (H, W, 3) uint8 by target."""
    from gvtools.runs.run import load_run
    from pipelines.evaluation.record import described
    from pipelines.evaluation.run_evaluation import evaluate_run

    seconds = _reconstruct(task)
    peak = peak_bytes()
    run = load_run(task.cell.run)
    figures = evaluate_run(
        run, parts=task.parts, lpips=task.lpips, no_lpips=None, control=False, console=Silent()
    )
    pictures = {target.name: files.picture for target, files, _ in run.targets()}
    return {
        **_summary(described(run, figures)),
        "seconds": seconds,
        "peak_bytes": peak,
        "gpu_bytes": _gpu_bytes(),
    }, pictures


def _reconstruct(task: _Task) -> float:
    """Run the method; returns the seconds from the opened scene to the finished run."""
    from gvtools.settings import with_values
    from pipelines.reconstruction.run import compile_kernels, reconstruct
    from pipelines.reconstruction.settings import RunSettings
    from pipelines.report.write import draw_run

    cell, benchmark = task.cell, task.benchmark
    # All methods work at the benchmark's size, also profiles that would reduce pictures further.
    side = RunSettings().max_side if task.size is None else None
    decided: dict[str, Any] = {**task.views, "seed": 0, "max_side": side}
    if benchmark.targets is not None:
        decided |= {"views_per_round": benchmark.targets, "rounds": benchmark.rounds}
    config = with_values(cell.method.config(seconds=cell.seconds), decided)
    # A killed run is started from scratch, so that the seconds are those of a whole run.
    shutil.rmtree(cell.run, ignore_errors=True)
    make_folder(cell.run.parent)
    compile_kernels(config, Silent())
    start = time.perf_counter()
    reconstruct(task.scene, config, cell.run, console=Silent(), reading=task.reading, draw=draw_run)
    return time.perf_counter() - start


def _of_pictures(task: _Task) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Figures of pictures in a folder, as ``gvtools judge`` has them, and the pictures by target.

    What the context observed, and the poses that pictures are located against, come from a memory
    of the context alone, which is kept in the cell's run.
    """
    from gvtools.runs.identity import versions
    from pipelines.evaluation.measurement import Measurement
    from pipelines.judging.methods import open_method
    from pipelines.judging.reference import observe_context

    cell = task.cell
    assert cell.method.pictures is not None
    make_folder(cell.run.parent)
    reference = observe_context(
        task.scene, cell.run, **task.views, cameras=None, reading=task.reading, console=Silent()
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
        parts=task.parts,
        context=reference.context,
        truths=[],
        lpips=task.lpips,
        no_lpips=None,
        control=False,
        console=Silent(),
    ).of([
        reference.with_surface(target) if target.picture.depth is None else target
        for target in method.targets
    ])  # fmt: skip
    evaluation = {**measured, "coverage": None, "versions": versions()}
    pictures = {target.picture.name: target.picture.rgb for target in method.targets}
    return _summary(evaluation), pictures


def _summary(evaluation: Mapping[str, Any]) -> dict[str, Any]:
    """What tables show of an evaluation, as ``gvtools evaluate`` has it."""
    from gvtools.evaluation.ranking import Setting
    from pipelines.evaluation.tables import measured_row, scalars
    from pipelines.report.nested import nested

    nothing = Setting(data_set=None, resolution=None, context=None, targets=None)
    figures = dict(measured_row("", [evaluation], nothing).figures)
    figures["psnr_observed"] = nested(evaluation, "images", "mean", "psnr_valid", "mean")
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
        "met3r": nested(evaluation, "consistency", "generated", "met3r", "status"),
        "versions": evaluation["versions"],
        "masked_share": evaluation["images"]["settings"]["masked_share"],
        "notes": evaluation["images"]["notes"],
    }


def peak_bytes() -> int | None:
    """Peak memory (RSS) of this process, bytes; None where the system does not tell."""
    try:
        with open("/proc/self/status", encoding="ascii") as status:
            return next(int(line.split()[1]) * 1024 for line in status if line[:6] == "VmHWM:")
    except (OSError, StopIteration):
        pass
    try:
        import resource
    except ImportError:
        return None
    # Bytes on macOS; Linux, where these are kilobytes, was read above.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _gpu_bytes() -> int | None:
    """Peak memory that torch allocated on the CUDA device, bytes; None where none was used."""
    import sys

    torch = sys.modules.get("torch")
    if torch is None or not torch.cuda.is_available():
        return None
    return int(torch.cuda.max_memory_allocated()) or None


class Silent(Console):
    """Prints nothing, warnings included; why a cell failed is written to its file."""

    def __init__(self) -> None:
        super().__init__(quiet=True)

    def warn(self, text: str) -> None:
        """Nothing."""
