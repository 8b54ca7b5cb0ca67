"""``gvtools bench complete``: a pass of the generative core, by stage: time, memory, FLOPs."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import torch

from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.flow import interval_bounds
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.stages import DECODE, VIDEO
from gvtools.completers.geoverse.weights.folder import from_pretrained
from pipelines.bench.flops import PassFlops, pass_flops
from pipelines.bench.options import CompleteOptions
from pipelines.bench.random_model import random_features, random_model, random_video, random_views
from pipelines.bench.side_by_side import Comparison
from pipelines.bench.stage_clock import PEAK, forget_peak, peak_bytes, total, within
from pipelines.bench.timing import (
    BETWEEN,
    EXPLICIT,
    PASS,
    TimedPass,
    Times,
    compare_attention,
)

if TYPE_CHECKING:
    from pipelines.console import Console

NO_PEER = "no peer: a part of this network"
NOT_RUN = "--flops-only: nothing was run"
STAND_IN = "the video prior is not run: random features stand in for its own"


def complete_figures(options: CompleteOptions) -> dict[str, Any]:
    """The figures as a JSON object: rows under ``results``, what is null under ``notes``."""
    config = options.network()
    batch = random_views(options.picture(config), context=options.context, targets=options.targets)
    bounds = interval_bounds(options.steps, shift=config.flow.shift)
    cascade_bounds = interval_bounds(options.cascade_steps, shift=config.flow.shift)
    video = options.runs_video(config)
    counted = pass_flops(config, batch, bounds=bounds, cascade_bounds=cascade_bounds, video=video)
    figures = _conditions(options, config, counted)
    notes: dict[str, str] = figures["notes"]
    times, rows = Times(), []
    if options.flops_only:
        notes |= dict.fromkeys(("ours_s", "first_pass_s", "memory", EXPLICIT), NOT_RUN)
    else:
        timed = TimedPass(
            _model(options, config),
            batch.to(options.place),
            bounds=bounds,
            cascade_bounds=cascade_bounds,
            rounded=options.rounded,
            video=None if video else random_features(config, batch.to(options.place)),
        )
        forget_peak(options.place)
        figures["first_pass_s"] = timed.run()
        figures["memory"] = {
            "weights_bytes": weight_bytes(timed.model),
            "peak_bytes": peak_bytes(options.place),
        }
        notes["memory"] = PEAK[options.place.type]
        times = timed.times(options.repeat)
        compared = compare_attention(timed, repeat=options.repeat)
        if isinstance(compared, Comparison):
            rows.append(compared.to_dict())
        else:
            notes[EXPLICIT] = compared
    figures["results"] = stage_rows(counted.rows, times) + rows
    return figures


def _conditions(
    options: CompleteOptions, config: GeoVerseConfig, counted: PassFlops
) -> dict[str, Any]:
    """What was measured, and where."""
    notes = {"peer": NO_PEER}
    if config.video is not None and not options.runs_video(config):
        notes[VIDEO] = STAND_IN
    if counted.video is not None:
        notes["flops"] = f"without the video prior's: {counted.video}"
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
        "precision": "bfloat16" if options.rounded else "float32",
        "video": options.runs_video(config),
        "compiled": options.compile,
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
        "cpus": os.cpu_count(),
        "load": os.getloadavg()[0],
        "parameters": counted.parameters,
        "flops_within": counted.within,
        "first_pass_s": None,
        "memory": {"weights_bytes": None, "peak_bytes": None},
        "notes": notes,
    }


def _model(options: CompleteOptions, config: GeoVerseConfig) -> GeoVerse:
    """The model on its device, with its video prior where that is asked for."""
    device, video = options.place, options.runs_video(config)
    if options.weights is not None:
        model = from_pretrained(options.weights, device=device, video=video)
    else:
        model = random_model(config, device)
        if video and config.video is not None:
            model.attach_video(random_video(config.video, device))
    if options.compile:
        for part in (model.level1, model.cascade, model.control, model.rgb_head):
            if part is not None:
                part.compile()
    return model


def stage_rows(counts: dict[str, float], times: Times) -> list[dict[str, Any]]:
    """The stage table, the whole pass last.

    Args:
        counts: FLOPs by row.
        times: of the same rows; without any, nothing was run.
    """
    counts = counts | {PASS: total(counts)}
    stages = total({name: s for name, s in times.median.items() if name != PASS})
    rows: list[dict[str, Any]] = []
    for name in (*(name for name in counts if name != PASS), BETWEEN, PASS):
        spent, work = times.median.get(name), counts.get(name)
        rows.append(
            {
                "name": name,
                "within": DECODE if within(name) else None,
                "ours_s": spent,
                "ours_min_s": times.least.get(name),
                "share": None if spent is None or name == PASS else spent / stages,
                "flops": work,
                "tflop_per_s": work / spent / 1e12 if spent and work else None,
                "peer": None,
                "peer_s": None,
                "ratio": None,
                "repeats": times.repeats,
                "note": NO_PEER,
            }
        )
    return rows


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
    stages = [row for row in figures["results"] if row["peer"] is None]
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
            for row in stages
        ],
    )
    for name, count in figures["flops_within"].items():
        console.line(f"{name}: {count / 1e12:.4g} TFLOP of the pass")
    console.table(
        ("part", "million parameters"),
        [(name, count / 1e6) for name, count in figures["parameters"].items()],
    )
    memory = figures["memory"]
    if memory["weights_bytes"] is not None:
        console.line(
            f"weights {memory['weights_bytes'] / 2**20:,.0f} MiB, "
            f"peak {memory['peak_bytes'] / 2**20:,.0f} MiB "
            f"({figures['notes']['memory']}); first pass {figures['first_pass_s']:.3g} s"
        )
    for row in figures["results"]:
        if row["peer"] is not None:
            console.line(
                f"{row['name']}: {row['ours_s']:.4g} s, {row['peer']} {row['peer_s']:.4g} s, "
                f"ratio {row['ratio']:.3g} ({row['ratio_of_minima']:.3g} of minima); {row['note']}"
            )
    for key in (VIDEO, "flops", EXPLICIT):
        if key in figures["notes"]:
            console.line(f"{key}: {figures['notes'][key]}")
