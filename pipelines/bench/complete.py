"""``gvtools bench complete``: a pass of the generative core, by stage: time, memory, FLOPs."""

from __future__ import annotations

import gc
import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.model import DECODE, DECODING, LEVEL0, LEVEL1, GeoVerse, no_clock
from gvtools.completers.geoverse.video_prior import VideoFeatures, VideoPrior, VideoPriorConfig
from gvtools.completers.geoverse.wan import dtype_of, empty_network
from gvtools.completers.geoverse.weights import from_pretrained
from gvtools.networks.compute import autocast
from pipelines.bench.options import CompleteOptions
from pipelines.machine import load_average, process_peak_bytes

if TYPE_CHECKING:
    from pipelines.console import Console


# Of random weights: small enough for the activations of deep networks to stay finite.
DEVIATION = 0.02
# Share of the targets' pixels that the projection knows, in blocks of an eighth of a side.
KNOWN = 0.7
BLOCKS = 8
TOKEN = 16  # px of a video token's edge


def random_model(config: GeoVerseConfig, device: torch.device | str = "cpu") -> GeoVerse:
    """A model in evaluation mode, without its video prior.

    Nothing is left at zero, as a fresh denoiser's gates are: zeros take a GPU less power, and so
    less time.
    """
    device = torch.device(device)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        with device:
            model = GeoVerse(config)
        for parameter in model.parameters():
            if not bool(parameter.any()):
                nn.init.normal_(parameter, std=DEVIATION)
    return model.eval()


def random_video(config: VideoPriorConfig, device: torch.device | str = "cpu") -> VideoPrior:
    """A video prior of the published network's sizes, truncated behind the last tap."""
    # What diffusers takes by default is the published network.
    sizes = {"num_layers": config.taps[-1] + 1, "vace_layers": list(config.taps)}
    dtype = getattr(torch, config.dtype or "bfloat16")
    transformer: Any = _filled(empty_network("transformer", sizes), device, dtype)
    table = transformer.config
    with torch.device(device):
        # Computed, not stored.
        transformer.rope = type(transformer.rope)(
            table.attention_head_dim, table.patch_size, table.rope_max_seq_len
        )
    vae = _filled(empty_network("vae", {}), device, torch.float32)
    return VideoPrior(transformer, vae, config=replace(config, prompt="zeros"))


def random_features(config: GeoVerseConfig, batch: ViewBatch) -> VideoFeatures | None:
    """What a video prior would give for the batch, on its device; None where there is none."""
    if config.video is None:
        return None
    rows, columns = (side // TOKEN for side in config.video.size(*batch.size))
    samples, views = batch.images.shape[:2]
    shape = (samples, views, config.video.channels, rows, columns)
    return tuple(torch.randn(shape, device=batch.images.device) for _ in config.video.taps)


def _filled(network: nn.Module, device: torch.device | str, dtype: torch.dtype) -> nn.Module:
    """A network of the meta device on another, with random weights."""

    def random(name: str, like: Tensor) -> Tensor:
        empty = torch.empty(like.shape, dtype=dtype_of(name, dtype), device=device)
        return empty.normal_(std=DEVIATION)

    state = {name: random(name, like) for name, like in network.state_dict().items()}
    network.load_state_dict(state, assign=True)
    return network


def random_views(size: tuple[int, int], *, context: int, targets: int) -> ViewBatch:
    """One sample of views on an arc about a point in front of them."""
    generator = torch.Generator().manual_seed(0)
    views, (height, width) = context + targets, size

    def uniform(*shape: int) -> Tensor:
        return torch.rand(1, views, *shape, generator=generator)

    known = uniform(1, BLOCKS, BLOCKS) < KNOWN
    known[:, :context] = True
    rows, columns = (torch.arange(side) * BLOCKS // side for side in size)
    valid = known[..., rows[:, None], columns]
    turn = torch.linspace(-0.3, 0.3, views)
    pose = torch.eye(4).repeat(1, views, 1, 1)
    pose[0, :, 0, 0] = pose[0, :, 2, 2] = turn.cos()
    pose[0, :, 0, 2], pose[0, :, 2, 0] = -turn.sin(), turn.sin()
    # Turned about (0, 0, 2), which stays in the middle of every view.
    pose[0, :, 0, 3], pose[0, :, 2, 3] = 2 * turn.sin(), 2 - 2 * turn.cos()
    focal = float(max(size))
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return ViewBatch(
        images=uniform(3, height, width) * valid,
        depth=(1.5 + uniform(1, height, width)) * valid,
        valid=valid,
        cam_from_world=pose,
        K=K.repeat(1, views, 1, 1),
        context=context,
    )


# Before the name of a part of the decoding.
INSIDE = f"{DECODE}: "


class StageClock:
    """Given to a model as its clock, it notes by how much ``total`` grows within each stage."""

    def __init__(self, total: Callable[[], float]) -> None:
        self.total = total
        # Stage and growth, in the order in which stages began.
        self.entries: list[tuple[str, float]] = []

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Note one stage."""
        place = len(self.entries)
        self.entries.append((stage, 0.0))
        before = self.total()
        yield
        self.entries[place] = (stage, self.total() - before)

    def rows(self, steps: Mapping[str, int]) -> dict[str, float]:
        """Growth by row of the stage table; of several evaluations a step, their sum."""
        found: dict[str, list[float]] = {}
        for stage, growth in self.entries:
            found.setdefault(stage, []).append(growth)
        rows = {}
        for stage, values in found.items():
            if stage not in steps:
                rows[f"{INSIDE}{stage}" if stage in DECODING else stage] = sum(values)
                continue
            share = len(values) // steps[stage]
            for step in range(steps[stage]):
                rows[f"{stage} {step + 1}"] = sum(values[step * share : (step + 1) * share])
        return rows


def total(rows: Mapping[str, float]) -> float:
    """Of all rows; what is within another row is not counted twice."""
    return sum(value for name, value in rows.items() if not name.startswith(INSIDE))


# What ``peak_bytes`` is, by the device's type.
PEAK = {
    "cuda": "what tensors held on the device, weights included",
    "cpu": "the most that the process ever held",
}


PASS = "pass"
BETWEEN = "between stages"
# torch counts attention on a GPU, not the kernel that it takes on a CPU.
CPU_ATTENTION = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu


class TimedPass:
    """A pass of a model over fixed views."""

    def __init__(
        self,
        model: GeoVerse,  # on ``device``
        batch: ViewBatch,
        *,
        sampling: Mapping[str, Any],  # see ``GeoVerse.generate``
        dtype: torch.dtype = torch.float32,
        video: VideoFeatures | None = None,
    ) -> None:
        self.model, self.batch, self.video, self.dtype = model, batch, video, dtype
        self.sampling = sampling
        self.device = batch.images.device
        # How often the stages with numbered steps are stepped through.
        bounds = {LEVEL1: sampling["bounds"], LEVEL0: sampling["cascade_bounds"]}
        self.steps = {level: len(times) - 1 for level, times in bounds.items()}

    def now(self) -> float:
        """Wall time [s], after all that was asked of the device is done."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()

    def run(self, clock: StageClock | None = None) -> float:
        """One pass; the seconds it took."""
        self.model.clock = clock or no_clock
        start = self.now()
        with autocast(self.device, self.dtype):
            self.model.generate(self.batch, video=self.video, **self.sampling)
        return self.now() - start

    def flops(self) -> dict[str, float]:
        """FLOPs by row of the stage table, counted in one pass.

        A multiplication and an addition count as two. Products, convolutions and attention are
        counted; what is done to single numbers (norms, activations, gates) is not.
        """
        attention = {CPU_ATTENTION: lambda q, k, v, *_, **__: sdpa_flop_count(q, k, v)}
        with FlopCounterMode(display=False, custom_mapping=attention) as counter:
            clock = StageClock(counter.get_total_flops)
            self.run(clock)
        return clock.rows(self.steps)

    def times(self, repeat: int) -> dict[str, list[float]]:
        """Seconds by row of the stage table, of each pass; a whole pass under ``PASS``.

        On a GPU, where a clock waits for the device, whole passes have none.
        """
        found: dict[str, list[float]] = {}
        for _ in range(repeat):
            gc.collect()
            clock = StageClock(self.now)
            whole = self.run(clock)
            rows = clock.rows(self.steps)
            rows[BETWEEN] = whole - total(rows)
            rows[PASS] = self.run() if self.device.type == "cuda" else whole
            for name, spent in rows.items():
                found.setdefault(name, []).append(spent)
        return found


def complete_figures(options: CompleteOptions) -> dict[str, Any]:
    """The figures as a JSON object, a row for each stage under ``results``."""
    config = options.network()
    batch = random_views(options.picture(config), context=options.context, targets=options.targets)
    batch = batch.to(options.place)
    model = _model(options, config)
    timed = TimedPass(
        model,
        batch,
        sampling=options.sampling(config),
        dtype=options.compute_type,
        video=None if options.runs_video(config) else random_features(config, batch),
    )
    counts = timed.flops()
    if options.compile:
        model.compile_blocks()
    gpu = options.place.type == "cuda"
    if gpu:
        torch.cuda.reset_peak_memory_stats(options.place)
    first_pass = timed.run()
    peak = torch.cuda.max_memory_allocated(options.place) if gpu else process_peak_bytes()
    return {
        **_conditions(options, config),
        "parameters": parameters(model),
        "first_pass_s": first_pass,
        "weights_bytes": module_bytes(model, *prior_networks(model)),
        "peak_bytes": peak or 0,
        "peak": PEAK[options.place.type],
        "results": stage_rows(counts, timed.times(options.repeat)),
    }


def _conditions(options: CompleteOptions, config: GeoVerseConfig) -> dict[str, Any]:
    """What is measured, and where."""
    gpu = options.place.type == "cuda"
    return {
        "bench": "complete",
        **options.conditions(config),
        "weights": "random" if options.weights is None else str(options.weights),
        "device": options.place.type,
        "device_name": torch.cuda.get_device_name(options.place) if gpu else None,
        "video": options.runs_video(config),
        "video_stand_in": config.video is not None and not options.runs_video(config),
        "compiled": options.compile,
        "repeats": options.repeat,
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
        "cpus": os.cpu_count(),
        "load": load_average(),
    }


def _model(options: CompleteOptions, config: GeoVerseConfig) -> GeoVerse:
    """The model on its device, with its video prior where that is asked for."""
    device, video = options.place, options.runs_video(config)
    if options.weights is not None:
        dtype = options.compute_type
        return from_pretrained(options.weights, device=device, dtype=dtype, video=video)
    model = random_model(config, device)
    model.hold_in(options.compute_type)
    if video and config.video is not None:
        model.attach_video(random_video(config.video, device))
    return model


def stage_rows(counts: dict[str, float], times: dict[str, list[float]]) -> list[dict[str, Any]]:
    """The stage table, the whole pass last."""
    median = {name: statistics.median(seconds) for name, seconds in times.items()}
    whole = median.pop(PASS)
    stages, rows = total(median), list[dict[str, Any]]()
    for name in (*counts, BETWEEN, PASS):
        spent = whole if name == PASS else median[name]
        work = total(counts) if name == PASS else counts.get(name)
        rows.append(
            {
                "name": name,
                "within": DECODE if name.startswith(INSIDE) else None,
                "ours_s": spent,
                "ours_min_s": min(times[name]),
                "share": None if name == PASS else spent / stages,
                "flops": work,
                "tflop_per_s": work / spent / 1e12 if work else None,
            }
        )
    return rows


def parameters(model: GeoVerse) -> dict[str, int]:
    """Numbers by part of the model, buffers not counted."""
    geometry = model.geometry
    parts: dict[str, tuple[Any, ...]] = {
        "encoder": (geometry.backbone,),
        "geometry head": (geometry.head,),
        "camera encoder and decoder": (geometry.cam_enc, geometry.cam_dec),
        "RGB head": (model.rgb_head,),
        "level-1 denoiser": (model.level1,),
        "cascade": (model.cascade,),
        "control branch": (model.control,),
        "shared attention": (model.shared,),
    }
    if model.video is not None:
        networks = model.video.networks
        parts |= {"video transformer": (networks.transformer,), "video VAE": (networks.vae,)}
    counts = {
        name: sum(p.numel() for part in group if part is not None for p in part.parameters())
        for name, group in parts.items()
    }
    counts = {name: count for name, count in counts.items() if count}
    return counts | {"total": sum(counts.values())}


def prior_networks(model: GeoVerse) -> list[nn.Module]:
    """The networks of its video prior; none without one."""
    if model.video is None:
        return []
    return [model.video.networks.transformer, model.video.networks.vae]


def module_bytes(*modules: nn.Module) -> int:
    """Of weights and buffers."""
    tensors = [t for module in modules for t in (*module.parameters(), *module.buffers())]
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


def show(figures: dict[str, Any], console: Console) -> None:
    """The figures as tables and lines."""
    size = "x".join(map(str, figures["size"]))
    console.line(
        f"{figures['config']}, {figures['weights']} weights, {figures['context']} + "
        f"{figures['targets']} views of {size}, {figures['steps']} + {figures['cascade_steps']} "
        f"steps, {figures['device_name'] or figures['device']}, {figures['precision']}"
    )
    console.table(
        ("stage", "s", "min s", "share", "TFLOP", "TFLOP/s"),
        [
            (row["name"], row["ours_s"], row["ours_min_s"],
             None if row["share"] is None else f"{row['share']:.1%}",
             None if row["flops"] is None else row["flops"] / 1e12, row["tflop_per_s"])
            for row in figures["results"]
        ],
    )  # fmt: skip
    console.table(
        ("part", "million parameters"),
        [(name, count / 1e6) for name, count in figures["parameters"].items()],
    )
    console.line(
        f"weights {figures['weights_bytes'] / 2**20:,.0f} MiB, "
        f"peak {figures['peak_bytes'] / 2**20:,.0f} MiB ({figures['peak']}); "
        f"first pass {figures['first_pass_s']:.3g} s"
    )
    if figures["video_stand_in"]:
        console.line("the video prior is not run: random features stand in for its own")
