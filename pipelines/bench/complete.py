"""``gvtools bench complete``: a pass of the generative core, by stage: time, memory, FLOPs."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import torch

from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.flow import interval_bounds
from gvtools.completers.geoverse.model import DECODE, GeoVerse
from gvtools.completers.geoverse.weights import from_pretrained
from gvtools.networks.compute import name_of
from pipelines.bench.options import CompleteOptions
from pipelines.bench.random_model import random_features, random_model, random_video, random_views
from pipelines.bench.stage_clock import PEAK, forget_peak, peak_bytes, total, within
from pipelines.bench.timing import BETWEEN, PASS, TimedPass, Times

if TYPE_CHECKING:
    from pipelines.console import Console


def complete_figures(options: CompleteOptions) -> dict[str, Any]:
    """The figures as a JSON object, a row for each stage under ``results``."""
    config = options.network()
    batch = random_views(options.picture(config), context=options.context, targets=options.targets)
    batch = batch.to(options.place)
    model = _model(options, config)
    timed = TimedPass(
        model,
        batch,
        bounds=interval_bounds(options.steps, shift=config.flow.shift),
        cascade_bounds=interval_bounds(options.cascade_steps, shift=config.flow.shift),
        dtype=options.compute_type,
        video=None if options.runs_video(config) else random_features(config, batch),
    )
    counts = timed.flops()
    if options.compile:
        for part in (model.level1, model.cascade, model.control, model.rgb_head):
            if part is not None:
                part.compile()
    forget_peak(options.place)
    first_pass = timed.run()
    return {
        **_conditions(options, config),
        "parameters": parameters(model),
        "first_pass_s": first_pass,
        "weights_bytes": weight_bytes(model),
        "peak_bytes": peak_bytes(options.place),
        "peak": PEAK[options.place.type],
        "results": stage_rows(counts, timed.times(options.repeat)),
    }


def _conditions(options: CompleteOptions, config: GeoVerseConfig) -> dict[str, Any]:
    """What is measured, and where."""
    gpu = options.place.type == "cuda"
    return {
        "bench": "complete",
        "config": config.name,
        "weights": "random" if options.weights is None else str(options.weights),
        "size": list(options.picture(config)),
        "context": options.context,
        "targets": options.targets,
        "steps": options.steps,
        "cascade_steps": options.cascade_steps,
        "device": options.place.type,
        "device_name": torch.cuda.get_device_name(options.place) if gpu else None,
        "precision": name_of(options.compute_type),
        "video": options.runs_video(config),
        "video_stand_in": config.video is not None and not options.runs_video(config),
        "compiled": options.compile,
        "repeats": options.repeat,
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
        "cpus": os.cpu_count(),
        "load": os.getloadavg()[0],
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


def stage_rows(counts: dict[str, float], times: Times) -> list[dict[str, Any]]:
    """The stage table, the whole pass last.

    Args:
        counts: FLOPs by row.
        times: of the same rows.
    """
    counts = counts | {PASS: total(counts)}
    stages = total({name: s for name, s in times.median.items() if name != PASS})
    rows: list[dict[str, Any]] = []
    for name in (*(name for name in counts if name != PASS), BETWEEN, PASS):
        spent, work = times.median[name], counts.get(name)
        rows.append(
            {
                "name": name,
                "within": DECODE if within(name) else None,
                "ours_s": spent,
                "ours_min_s": times.least[name],
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


def weight_bytes(model: GeoVerse) -> int:
    """Of the model and its video prior, buffers included."""
    modules: list[Any] = [model]
    if model.video is not None:
        modules += [model.video.networks.transformer, model.video.networks.vae]
    return sum(
        tensor.numel() * tensor.element_size()
        for module in modules
        for tensor in (*module.parameters(), *module.buffers())
    )


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
            (
                row["name"],
                row["ours_s"],
                row["ours_min_s"],
                None if row["share"] is None else f"{row['share']:.1%}",
                None if row["flops"] is None else row["flops"] / 1e12,
                row["tflop_per_s"],
            )
            for row in figures["results"]
        ],
    )
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
