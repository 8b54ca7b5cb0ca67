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
from pipelines.benchmark.pictures import find_picture, masked_figures, object_mask, write_thumbnails
from pipelines.benchmark.scenes import (
    longest_side,
    open_benchmark_scene,
    prepared,
    split_of_scene,
)
from pipelines.console import Console

if TYPE_CHECKING:
    from gvtools.evaluation.lpips_distance import Lpips
    from gvtools.evaluation.splits import SceneSplit
    from gvtools.scenes.scene import Scene

# Figures that take more than comparing pictures.
OF_POSES = {"ate", "rpe_r", "rpe_t", "reproj", "met3r"}


@dataclass(frozen=True, kw_only=True)
class Cell:
    """What is measured, and where it is kept.

    Attributes:
        benchmark: name of its specification.
        root: folder of the data set, or of the projects.
        scene: its name.
        views: number of context views.
        method: what makes the pictures.
        seconds: of each fit; None leaves it to the method.
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
        """The file of the figures."""
        return (self.out / "cells" / self.stem).with_name(f"{self.method.name}.json")

    @property
    def run(self) -> Path:
        """The folder of the run, where gvtools makes the pictures."""
        return self.out / "runs" / self.stem


def measure_cell(cell: Cell) -> dict[str, Any]:
    """Make the pictures of a cell, if they are not there, and measure them.

    Returns:
        Figures and what they were measured on, JSON-ready.

    Raises:
        GvError: the scene cannot be read, or the method refuses it.
    """
    from gvtools.evaluation.lpips_distance import Lpips

    benchmark = load_benchmark(cell.benchmark).at(cell.views)
    recorded = open_benchmark_scene(benchmark, cell.scene, cell.root)
    split = split_of_scene(benchmark, recorded)
    scene = prepared(benchmark, recorded, split)
    lpips = None if cell.lpips is None else Lpips(cell.lpips[0], folder=cell.lpips[1])
    if cell.method.pictures is None:
        side = longest_side(benchmark, recorded)
        figures, pictures = _of_run(cell, benchmark, scene, split=split, side=side, lpips=lpips)
    else:
        figures, pictures = _of_pictures(cell, scene, split, lpips=lpips)
    masks = {
        name: object_mask(benchmark, cell.root, scene=cell.scene, index=recorded.names.index(name),
                          shape=picture.shape[:2])
        for name, picture in pictures.items()
    }  # fmt: skip
    figures["figures"] |= masked_figures(pictures, scene, masks, lpips=lpips)
    write_thumbnails(cell.result, pictures, scene, context=split.context)
    sizes = {picture.shape[:2] for picture in pictures.values()}
    return {
        "split": {"context": list(split.context), "rounds": [list(r) for r in split.rounds]},
        "resolution": [*sizes.pop()][::-1] if len(sizes) == 1 else None,
        "masked": bool(masks) and all(mask is not None for mask in masks.values()),
        "poses_from": None,
        "met3r": None,
        **figures,
    }


def _of_run(
    cell: Cell,
    benchmark: Benchmark,
    scene: Scene,
    *,
    split: SceneSplit,
    side: int | None,
    lpips: Lpips | None,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Figures, and completed pictures by target."""
    from gvtools.runs.run import load_run
    from pipelines.evaluation.record import described
    from pipelines.evaluation.run_evaluation import PARTS, evaluate_run

    seconds = _reconstruct(cell, benchmark, scene, split=split, side=side)
    peak = peak_bytes()
    run = load_run(cell.run)
    poses = bool(OF_POSES & set(benchmark.figures))
    evaluation = described(
        run,
        evaluate_run(
            run,
            parts=PARTS if poses else ("images",),
            lpips=lpips,
            no_lpips=None,
            control=False,
            console=Silent(),
        ),
    )
    pictures = {target.name: files.picture for target, files, _ in run.targets()}
    return {
        **_summary(evaluation),
        "seconds": seconds,
        "peak_bytes": peak,
        "gpu_bytes": _gpu_bytes(),
    }, pictures


def _reconstruct(
    cell: Cell, benchmark: Benchmark, scene: Scene, *, split: SceneSplit, side: int | None
) -> float:
    """Run the method from its start; seconds from the opened scene to the finished run."""
    from gvtools.settings import with_values
    from pipelines.reconstruction.compile_kernels import compile_kernels
    from pipelines.reconstruction.run import reconstruct
    from pipelines.report.write import draw_run

    config = cell.method.config(seconds=cell.seconds)
    # The size of the pictures is the benchmark's, also of methods that would work on smaller ones.
    decided: dict[str, Any] = {
        "context": ",".join(split.context), "targets": ",".join(split.targets), "seed": 0,
        "max_side": side,
    }  # fmt: skip
    if benchmark.targets is not None:
        decided |= {"views_per_round": benchmark.targets, "rounds": benchmark.rounds}
    config = with_values(config, decided)
    # What a kill left is made anew, so that seconds are those of a whole run.
    shutil.rmtree(cell.run, ignore_errors=True)
    make_folder(cell.run.parent)
    compile_kernels(config, Silent())
    start = time.perf_counter()
    # With this, every command opens the run's scene as it was.
    size = benchmark.resolution
    reading: dict[str, Any] = {} if size is None else {"resolution": list(size)}
    if scene.origin is not None:
        reading["root"] = str(scene.origin.root)
    reconstruct(scene, config, cell.run, console=Silent(), reading=reading, draw=draw_run)
    return time.perf_counter() - start


def _summary(evaluation: Mapping[str, Any]) -> dict[str, Any]:
    """What tables show of an evaluated run."""
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


def _of_pictures(
    cell: Cell, scene: Scene, split: SceneSplit, *, lpips: Lpips | None
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Figures of pictures in a folder, and the pictures by target."""
    from gvtools.evaluation.view_figures import view_figures
    from pipelines.reconstruction.measure import mean_of

    assert cell.method.pictures is not None
    pictures, views = {}, []
    for name in split.targets:
        picture = find_picture(cell.method.pictures, cell.scene, name, views=cell.views)
        truth = scene[name].load()
        if picture.shape != truth.rgb.shape:
            raise ProjectError(
                f"{cell.method.pictures}: the picture of {name} is {picture.shape[1]}x"
                f"{picture.shape[0]} pixels; expected {truth.rgb.shape[1]}x{truth.rgb.shape[0]}"
            )
        # What stands on observations is a matter of a memory, which pictures do not have.
        none = np.zeros(picture.shape[:2], np.bool_)
        found = view_figures(picture, truth, observed=none, generated=none, lpips=lpips)
        views.append({"name": name, "round": 1, **found})
        pictures[name] = picture
    figures = {name: mean_of(views, name) for name in ("psnr", "ssim", "lpips")}
    return {"figures": figures, "views": views}, pictures


def peak_bytes() -> int | None:
    """The most memory that this process has held, bytes; None where the system does not tell."""
    try:
        with open("/proc/self/status", encoding="ascii") as status:
            return next(int(line.split()[1]) * 1024 for line in status if line[:6] == "VmHWM:")
    except (OSError, StopIteration):
        pass
    try:
        import resource
    except ImportError:
        return None
    # Only Linux counts kilobytes, and it is served above.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _gpu_bytes() -> int | None:
    """The most that torch has held of a CUDA device; None where none was used."""
    import sys

    torch = sys.modules.get("torch")
    if torch is None or not torch.cuda.is_available():
        return None
    return int(torch.cuda.max_memory_allocated()) or None


class Silent(Console):
    """Prints nothing, warnings included; what went wrong stands in a cell's file."""

    def __init__(self) -> None:
        super().__init__(quiet=True)

    def warn(self, text: str) -> None:
        """Nothing."""
