"""Everything here that runs on a CUDA card, as one table to send to the project.

    python -m benchmarks.gpu [--out gpu.md] [--config tiny|base] [--small]

From a clone's root, on a machine with a CUDA build of torch. A part that fails gives its error as
its row, and the others go on. Exit status: 0 where all parts succeeded, 1 where one failed, 2
without a CUDA device.

The parts: the tests that are marked ``gpu``; ``gvtools bench complete``; projecting a memory by the
torch back end beside the compiled one of the CPU; a picture of Gaussians with its gradients by
gsplat beside the CPU's; a depth map by plane sweep beside the CPU's; one training step.
"""

from __future__ import annotations

import argparse
import platform
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

import gvtools

ROOT = Path(__file__).parents[1]
Figures = dict[str, str]
LONGEST_ERROR = 160
# Models of pictures of this side train one sample at a time, and recompute layers. [px]
LARGE = 256


@dataclass(frozen=True)
class Sizes:
    """How much is computed.

    Attributes:
        config: of the generative core, random weights.
        tests: arguments that select the tests.
        repeat: timed turns.
        compile: measure passes of compiled blocks, too.
        points: voxels of the memory that is projected.
        picture: (W, H) of projections and of pictures of Gaussians, px.
        gaussians: how many.
        side: longest of plane sweep, px.
        stereo: other options of plane sweep.
        core: (H, W) of the core's views; None for the configuration's.
        samples: of the training step.
    """

    config: str = "tiny"
    tests: tuple[str, ...] = ("tests", "-m", "gpu")
    repeat: int = 7
    compile: bool = True
    points: int = 1_000_000
    picture: tuple[int, int] = (640, 480)
    gaussians: int = 100_000
    side: int = 640
    stereo: Mapping[str, int] = field(default_factory=dict)
    core: tuple[int, int] | None = None
    samples: int = 4


SMALL: dict[str, Any] = {
    "repeat": 1,
    "compile": False,
    "points": 20_000,
    "picture": (48, 36),
    "gaussians": 300,
    "side": 64,
    "stereo": {"levels": 1, "sources": 1, "best": 1, "planes": 16, "speckle": 0},
    "core": (36, 36),
    "samples": 1,
}


def timed(call: Callable[[], object], repeat: int) -> float:
    """Median seconds of a call after one that is not timed, the device's work included."""
    seconds = []
    for _ in range(repeat + 1):
        torch.cuda.synchronize()
        start = time.perf_counter()
        call()
        torch.cuda.synchronize()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[1:])


def tests(sizes: Sizes) -> Figures:
    """The tests that need a CUDA device, by pytest.

    Raises:
        RuntimeError: some failed, or none ran.
    """
    words = ["-m", "pytest", *sizes.tests, "-q", "-p", "no:cacheprovider", "-rf", "--tb=no"]
    run = subprocess.run(
        [sys.executable, *words], cwd=ROOT, capture_output=True, text=True, check=False
    )
    lines = (run.stdout + run.stderr).strip().splitlines() or ["no output"]
    if run.returncode:
        failed = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
        raise RuntimeError("; ".join([lines[-1], *failed]))
    return {"passed": lines[-1].strip("= ")}


def complete(sizes: Sizes) -> Figures:
    """``gvtools bench complete``, in bfloat16 and in float32."""
    from pipelines.bench.complete import complete_figures
    from pipelines.bench.options import CompleteOptions

    found: Figures = {}
    ways = {"bfloat16": False, "float32": False}
    if sizes.compile:
        ways["bfloat16, compiled"] = True
    for way, compiled in ways.items():
        options = CompleteOptions(
            config=sizes.config, size=sizes.core, device="cuda", precision=way.split(",")[0],
            repeat=sizes.repeat, compile=compiled,
        )  # fmt: skip
        figures = complete_figures(options)
        *stages, whole = figures["results"]
        found[f"a pass of {sizes.config}, {way}"] = (
            f"{whole['ours_s'] * 1e3:.1f} ms, {whole['tflop_per_s']:.3g} TFLOP/s, first "
            f"{figures['first_pass_s']:.2f} s, peak {figures['peak_bytes'] / 2**20:,.0f} MiB"
        )
        found[f"its parts, {way}"] = ", ".join(
            f"{row['name']} {row['ours_s'] * 1e3:.0f} ms" for row in stages if not row["within"]
        )
        torch.cuda.empty_cache()
    return found


def projection(sizes: Sizes) -> Figures:
    """A memory of a box's walls into a camera inside it."""
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.memory.splat.api import SplatOptions
    from pipelines.bench import procedural_cloud

    edge = 0.005
    box = procedural_cloud.box_size(sizes.points, edge)
    memory = SpatialMemory(edge)
    for wall in procedural_cloud.walls(box, edge):
        memory.fuse(wall, round=0)
    width, height = sizes.picture
    camera = procedural_cloud.inside_camera(box, turn=0.3, width=width, height=height)
    ways = {
        "torch, CUDA": SplatOptions(backend="torch", device="cuda"),
        "compiled, CPU": SplatOptions(),
    }
    pictures = {name: memory.project(camera, options=ways[name]) for name in ways}
    one, two = pictures.values()
    apart = float(np.abs(one.rgb - two.rgb)[one.valid & two.valid].max(initial=0))
    what = f"{memory.voxels:,} voxels into {width}x{height}"
    rows = {}
    for name, options in ways.items():
        seconds = timed(partial(memory.project, camera, options=options), sizes.repeat)
        rows[f"{what}, {name}"] = f"{seconds * 1e3:.1f} ms"
    return rows | {f"{what}, largest difference": f"{apart:.2g}"}


def gaussians(sizes: Sizes) -> Figures:
    """A picture of random Gaussians and its gradients."""
    from gvtools.appearance.gaussians import Gaussians
    from gvtools.appearance.splat.gsplat_splatter import GsplatSplat
    from gvtools.appearance.splat.splat import Lens, Splat

    rng = np.random.default_rng(0)
    width, height = sizes.picture
    places = rng.uniform((-2, -1.5, 2), (2, 1.5, 5), (sizes.gaussians, 3))
    colors = rng.integers(0, 256, places.shape)
    edge = 2 / np.sqrt(sizes.gaussians)
    values = Gaussians.at(places, colors, sizes=np.full(len(places), edge)).values
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]])
    lens = Lens.of(np.eye(4), K, size=(width, height), near=0.1)
    gradient = rng.standard_normal((5, height, width)).astype(np.float32)
    rows = {}
    for name, kind in {"gsplat, CUDA": GsplatSplat, "compiled, CPU": Splat}.items():

        def drawn(kind: type[Splat] = kind) -> None:
            kind(values, lens).backward(gradient)

        seconds = timed(drawn, sizes.repeat)
        rows[f"{len(values):,} in {width}x{height}, {name}"] = f"{seconds * 1e3:.1f} ms"
    apart = float(np.abs(GsplatSplat(values, lens).image - Splat(values, lens).image).max())
    return rows | {"largest difference": f"{apart:.2g}"}


def plane_sweep(sizes: Sizes) -> Figures:
    """Depth of one view of the demo's room from its photographs."""
    from gvtools.depth.options import StereoOptions
    from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo
    from gvtools.procedural.room_sample import write_room
    from gvtools.scenes.project import open_project

    base = StereoOptions(max_side=sizes.side, align=False, **sizes.stereo)
    ways = {
        "torch, CUDA": base.replaced(backend="torch", device="cuda"),
        "compiled, CPU": base.replaced(backend="cpu"),
    }
    rows, depths = {}, []
    with tempfile.TemporaryDirectory() as folder:
        write_room(Path(folder) / "room", views=5)
        scene = open_project(Path(folder) / "room")
        view = scene.views[2]
        frame = view.load()
        for name, options in ways.items():

            def depth(options: StereoOptions = options) -> np.ndarray:
                stereo = PlaneSweepStereo(scene, options=options, views=scene.names)
                return stereo.depth(scene, view, frame).depth

            rows[f"a view at {sizes.side} px, {name}"] = (
                f"{timed(depth, min(sizes.repeat, 2)):.2f} s"
            )
            depths.append(depth())
    both = (depths[0] > 0) & (depths[1] > 0)
    if not both.any():
        raise RuntimeError(f"of {both.size} pixels none has depth by both back ends")
    apart = np.abs(depths[0][both] / depths[1][both] - 1)
    return rows | {"98 % of depths agree within": f"{np.quantile(apart, 0.98):.2%}"}


def training_step(sizes: Sizes) -> Figures:
    """A step of stage ``denoiser`` on random views, in bfloat16: loss, gradients, AdamW."""
    from gvtools.completers.geoverse.config import named
    from gvtools.networks.compute import set_recompute
    from gvtools.training.options import DenoiserStageOptions
    from gvtools.training.samples import Draws, TrainingBatch
    from gvtools.training.stages import DenoiserStage
    from pipelines.bench.complete import random_model, random_views

    config = named(sizes.config)
    if config.video is not None:
        config = replace(config, name=f"{config.name} without video", video=None, injection="none")
    size = sizes.core or (config.image_size, config.image_size)
    views = random_views(size, context=2, targets=2)
    samples = sizes.samples if config.image_size < LARGE else 1
    views = views.samples(torch.zeros(samples, dtype=torch.long))
    batch = TrainingBatch(views, views.images, views.depth + 1.5 * ~views.valid)
    batch = batch.to("cuda")
    stage = DenoiserStage(random_model(config, "cuda"), DenoiserStageOptions()).to("cuda")
    set_recompute(stage, config.image_size >= LARGE)
    learning = [p for p in stage.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(learning, lr=1e-5)
    losses: list[float] = []

    def step() -> None:
        draws = Draws(0, stage.name, len(losses), tuple(range(samples)))
        with torch.autocast("cuda", dtype=torch.bfloat16):
            loss, _ = stage(batch, draws)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        losses.append(float(loss.detach()))

    torch.cuda.reset_peak_memory_stats()
    seconds = timed(step, sizes.repeat)
    if not np.isfinite(losses).all():
        raise RuntimeError(f"the losses are {losses}; expected finite numbers")
    peak = torch.cuda.max_memory_allocated() / 2**20
    what = f"{config.name}, {samples} x 4 views of {size[0]}x{size[1]}, bfloat16"
    return {what: f"{seconds * 1e3:.0f} ms, peak {peak:,.0f} MiB"}


PARTS: Mapping[str, Callable[[Sizes], Figures]] = {
    "tests": tests,
    "bench complete": complete,
    "projection": projection,
    "Gaussians": gaussians,
    "plane sweep": plane_sweep,
    "training step": training_step,
}


def conditions() -> Figures:
    """The card, and what drives it."""
    properties = torch.cuda.get_device_properties(0)
    major, minor = torch.cuda.get_device_capability(0)
    return {
        "card": f"{torch.cuda.get_device_name(0)}, {properties.total_memory / 2**30:.1f} GiB",
        "compute capability": f"{major}.{minor}",
        "driver": _answer("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"),
        "torch": f"{torch.__version__}, CUDA {torch.version.cuda}",
        "gvtools": f"{gvtools.__version__}, {_answer('git', 'rev-parse', '--short', 'HEAD')}",
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
    }


def _answer(*words: str) -> str:
    """The first line that a program prints, "unknown" where there is no such program."""
    try:
        run = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return (run.stdout.strip().splitlines() or ["unknown"])[0]


def measured(
    sizes: Sizes, parts: Mapping[str, Callable[[Sizes], Figures]] = PARTS
) -> tuple[list[tuple[str, str, str]], bool]:
    """Rows of part, what and figure; and whether no part failed."""
    rows, good = [], True
    for name, part in parts.items():
        print(f"{name} ...", file=sys.stderr, flush=True)
        try:
            rows += [(name, what, figure) for what, figure in part(sizes).items()]
        except Exception as error:  # whatever a part fails with, the others are measured
            good = False
            text = " ".join(str(error).split())[:LONGEST_ERROR]
            rows.append((name, "failed", f"{type(error).__name__}: {text}"))
    return rows, good


def table(header: Figures, rows: Sequence[tuple[str, str, str]]) -> str:
    """Both as one markdown table."""
    lines = [("part", "what", "figure"), ("---", "---", "---")]
    lines += [("conditions", what, figure) for what, figure in header.items()]
    lines += rows
    escaped = [[re.sub(r"([|\\])", r"\\\1", cell) for cell in line] for line in lines]
    return "".join(f"| {' | '.join(line)} |\n" for line in escaped)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print and write the table; the exit status."""
    parser = argparse.ArgumentParser(prog="benchmarks.gpu", description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the table there, too")
    parser.add_argument("--config", choices=("tiny", "base"), default="tiny", help="(tiny)")
    parser.add_argument("--small", action="store_true", help="small sizes: seconds, not minutes")
    args = parser.parse_args(argv)
    if not torch.cuda.is_available():
        print(
            f"benchmarks.gpu: torch {torch.__version__} sees no CUDA device; run it on a machine "
            "with one and a CUDA build of torch",
            file=sys.stderr,
        )
        return 2
    sizes = Sizes(config=args.config, **(SMALL if args.small else {}))
    rows, good = measured(sizes)
    text = table(conditions(), rows)
    print(text, end="")
    if args.out is not None:
        args.out.write_text(text, encoding="utf-8")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
