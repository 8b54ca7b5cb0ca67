"""``gvtools bench complete --memory``: the peak memory of a pass and of a training step, predicted.

The library's own code runs on tensors without numbers (torch's fake ones: shapes, types and
lifetimes, but no memory), whose bytes are counted. Figures are of one device that holds everything;
what its driver takes, and what an allocator loses between tensors, comes on top.
"""

from __future__ import annotations

import itertools
import multiprocessing
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import (
    DataDependentOutputException,
    DynamicOutputShapeException,
    FakeTensorMode,
)
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.model import DECODE, DECODING, VIDEO, GeoVerse
from gvtools.completers.geoverse.wan import BLOCKS
from gvtools.networks.compute import autocast, name_of
from gvtools.training.distributed import Processes, Replicated
from gvtools.training.loop import Trainer
from gvtools.training.options import DenoiserStageOptions, OptimizerOptions, ReflowStageOptions
from gvtools.training.samples import TrainingBatch
from gvtools.training.stages import DenoiserStage, ReflowStage, Stage
from pipelines.bench.complete import (
    INSIDE,
    module_bytes,
    prior_networks,
    random_video,
    random_views,
)
from pipelines.bench.options import CompleteOptions

if TYPE_CHECKING:
    from pipelines.console import Console


_ATEN = torch.ops.aten
# Of a peak, by which the next one is larger at least; 0 would look through everything at each step.
NOTICED = 0.002
_expired = torch.UntypedStorage._expired
_forget = torch.UntypedStorage._free_weak_ref


class LiveBytes(TorchDispatchMode):
    """Counts the bytes of tensors created within it; views of one memory count once.

    What a kernel takes for itself and gives back before it returns is not seen. A new peak is
    noticed from ``NOTICED`` above the last one on: whether memory is still held has to be asked for
    every piece of it.
    """

    def __init__(self, known: Iterable[nn.Module] = ()) -> None:
        super().__init__()
        # Bytes, and torch's own weak reference, of every memory by its address.
        self._held: dict[int, tuple[int, Any]] = {}
        self._known = {
            tensor.untyped_storage()._cdata
            for module in known
            for tensor in (*module.parameters(), *module.buffers())
        }
        # At most what is held: what was given back since the last look is still in it.
        self._most = 0
        self.peak = 0  # the most bytes that were held since ``forget_peak``

    def __torch_dispatch__(  # noqa: PLR0917
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        """Run an operation and count what it created."""
        out = run_without_numbers(func, *args, **(kwargs or {}))
        for leaf in tree_leaves(out):
            if isinstance(leaf, Tensor):
                self._hold(leaf)
        if self._most > self.peak * (1 + NOTICED):
            self.peak = max(self.peak, self.live)
        return out

    @property
    def live(self) -> int:
        """Bytes held now."""
        gone = [key for key, (_, weak) in self._held.items() if _expired(weak)]
        for key in gone:
            _forget(self._held.pop(key)[1])
        self._most = sum(size for size, _ in self._held.values())
        return self._most

    def forget_peak(self) -> None:
        """Begin a new peak at what is held now."""
        self.peak = self.live

    def __exit__(self, *error: Any) -> None:
        """Let go of what was counted; ``peak`` stays."""
        super().__exit__(*error)
        for _, weak in self._held.values():
            _forget(weak)
        self._held.clear()
        self._most = 0

    def _hold(self, tensor: Tensor) -> None:
        storage = tensor.untyped_storage()
        key = storage._cdata
        if key in self._known:
            return
        if key in self._held:
            # The address may be that of memory which was given back: torch's reference tells.
            if not _expired(self._held[key][1]):
                return
            size, weak = self._held.pop(key)
            _forget(weak)
            self._most -= size
        self._held[key] = (storage.nbytes(), storage._weak_ref())
        self._most += storage.nbytes()


@contextmanager
def fake_tensors() -> Iterator[None]:
    """Within the block tensors have no numbers; models and views have to be made in it.

    For a process that does nothing else (``alone``): torch 2.13 has crashed where a process went on
    after training steps without numbers.
    """
    with FakeTensorMode(allow_non_fake_inputs=True), warnings.catch_warnings():
        # torch copies such a tensor by a way that it warns of itself.
        warnings.filterwarnings("ignore", "Accessing the data pointer of FakeTensor")
        yield


def alone(run: Callable[..., Any], *given: Any, **named: Any) -> Any:
    """``run(*given, **named)`` in a process of its own; all of it has to be picklable."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(run, *given, **named).result()


def run_without_numbers(func: Any, *args: Any, **kwargs: Any) -> Any:
    """What an operation gives, on whatever tensors.

    Where that depends on numbers, it is the ordinary, full case: checks pass and every view is
    informative. A truth is True, a number 0, all places are found.
    """
    with suppress(DataDependentOutputException, DynamicOutputShapeException):
        return func(*args, **kwargs)
    if func is _ATEN._local_scalar_dense.default:
        return True if args[0].dtype == torch.bool else 0.0
    if func is _ATEN.nonzero.default:
        return args[0].new_empty((args[0].numel(), args[0].ndim), dtype=torch.long)
    if func is _ATEN.unique_dim.default:
        index = args[0].new_empty(args[0].shape[args[1]], dtype=torch.long)
        return args[0].narrow(args[1], 0, 1).clone(), index, index[:1].clone()
    if func is _ATEN.index.Tensor and [index.dtype for index in args[1]] == [torch.bool]:
        mask = args[1][0]
        return args[0].new_empty((mask.numel(), *args[0].shape[mask.ndim :]))
    raise NotImplementedError(f"{func} depends on numbers, and none are there")


CPU = torch.device("cpu")
FORWARD, BACKWARD, OPTIMISER = PARTS = "forward", "backward", "optimiser"
WITHOUT, WITH = "without the video prior", "with the video prior"
# The stages that train a large model: the denoisers, then their distillation beside a teacher.
STAGES: dict[str, tuple[type[Stage], Any]] = {
    "denoiser": (DenoiserStage, DenoiserStageOptions),
    # How often its teacher steps changes the time alone.
    "reflow": (ReflowStage, partial(ReflowStageOptions, steps=1)),
}


class StagePeaks:
    """Given to a model as its clock, it notes the most bytes that were live within each stage."""

    def __init__(self, live: LiveBytes) -> None:
        self.live = live
        # Bytes by stage; of several runs of a stage the most.
        self.rows: dict[str, int] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Note one stage."""
        name = f"{INSIDE}{stage}" if stage in DECODING else stage
        # In the order in which stages begin.
        self.rows.setdefault(name, 0)
        outer = self.live.peak
        self.live.forget_peak()
        yield
        self.rows[name] = max(self.rows[name], self.live.peak)
        self.live.peak = max(outer, self.live.peak)


def pass_peaks(
    model: GeoVerse, batch: ViewBatch, *, dtype: torch.dtype, **sampling: Any
) -> dict[str, int]:
    """Bytes beside the weights at the peak of each stage of a pass; see ``GeoVerse.generate``."""
    with LiveBytes([model, *prior_networks(model)]) as live, autocast(CPU, dtype):
        peaks = model.clock = StagePeaks(live)
        model.generate(batch, **sampling)
    return peaks.rows


def step_peaks(
    model: GeoVerse, batch: TrainingBatch, optimizer: OptimizerOptions, *, stage: str = "denoiser"
) -> dict[str, int]:
    """Bytes beside the weights at the peak of each part of a training step.

    Gradients, averages, the optimiser's moments and a teacher are among them; ``held`` is what
    stays between steps. Of two steps the second counts: the first makes the moments.

    ``stage``: "denoiser" or "reflow".
    """
    with LiveBytes([model, *prior_networks(model)]) as live:
        kind, options = STAGES[stage]
        trained = kind(model, options(optimizer=optimizer))
        trainer = Trainer(
            _InPlace(trained, Processes(0, 1, CPU)),
            optimizer,
            lambda parts: (batch for _ in parts),
            folder=Path(),
            seed=0,
            identity={},
        )
        for group in trainer.optimizer.param_groups:
            # What AdamW does on a GPU: all parameters at once, with room for one more of each.
            group["foreach"] = True
        rows: dict[str, int] = {}

        def note(name: str) -> None:
            rows[name] = live.peak
            live.forget_peak()

        trained.register_forward_hook(lambda *_: note(FORWARD))
        trainer.optimizer.register_step_pre_hook(lambda *_: note(BACKWARD))
        for _ in range(2):
            live.forget_peak()
            trainer.step(iter([batch]))
            note(OPTIMISER)
        return {"held": live.live, **rows}


class _InPlace(Replicated):
    """Tensors without numbers cannot be moved, and need not be."""

    def _distribute(self) -> None:
        pass


def memory_figures(options: CompleteOptions) -> dict[str, Any]:
    """The predicted bytes as a JSON object: rows under ``inference`` and ``training``."""
    config = options.network()
    configs = {WITHOUT: replace(config, video=None, injection="none")}
    if config.video is not None and options.video is not False:
        configs[WITH] = config
    figures: dict[str, Any] = {
        "bench": "memory",
        **options.conditions(config),
        "training_precision": name_of(_trained_type(options)),
        "card_gb": options.card,
        "inference": [],
        "training": [],
    }
    for model, chosen in configs.items():
        rows = alone(_inference, options, chosen)
        figures["inference"] += [{"model": model, **row} for row in rows]
        for stage, recompute in itertools.product(STAGES, (False, True)):
            row = alone(_training, options, chosen, stage, recompute=recompute)
            figures["training"].append({"model": model, **row})
    return figures


def _inference(options: CompleteOptions, config: GeoVerseConfig) -> list[dict[str, Any]]:
    """A row for each stage of a pass."""
    dtype = options.compute_type
    with fake_tensors():
        model = model_without_numbers(config)
        model.hold_in(dtype)
        sampling = options.sampling(config)
        peaks = pass_peaks(model, _views(options, config), dtype=dtype, **sampling)
        weights, prior = module_bytes(model), module_bytes(*prior_networks(model))
        visiting = prior - away_bytes(model)
    return [
        {
            "stage": stage,
            "weights_bytes": weights,
            "video_bytes": prior,
            "activation_bytes": peak,
            # The prior is on the card for its own stage alone, or stays there.
            "total_bytes": weights + peak + (visiting if stage == VIDEO else 0),
            "total_bytes_video_stays": weights + peak + prior,
        }
        for stage, peak in peaks.items()
        if stage != DECODE
    ]


def away_bytes(model: GeoVerse) -> int:
    """Of a visiting prior's blocks, but for the two that are on the card at a time."""
    if model.video is None:
        return 0
    transformer = model.video.networks.transformer
    blocks = [block for name in BLOCKS for block in getattr(transformer, name)]
    return sum(sorted(map(module_bytes, blocks))[:-2])


def _training(
    options: CompleteOptions, config: GeoVerseConfig, stage: str, *, recompute: bool
) -> dict[str, Any]:
    """A step of one sample; the video prior stays on the card."""
    dtype = _trained_type(options)
    with fake_tensors():
        model = model_without_numbers(config)
        views = _views(options, config)
        batch = TrainingBatch(views, torch.rand_like(views.images), 1 + views.depth)
        optimizer = OptimizerOptions(batch=1, precision=name_of(dtype), recompute=recompute)
        peaks = step_peaks(model, batch, optimizer, stage=stage)
        weights = module_bytes(model, *prior_networks(model))
    held = weights + peaks.pop("held")
    return {
        "stage": stage,
        "recompute": recompute,
        "weights_bytes": weights,
        "lasting_bytes": held,
        **{f"{part}_bytes": weights + peak for part, peak in peaks.items()},
        "total_bytes": weights + max(peaks.values()),
    }


def _trained_type(options: CompleteOptions) -> torch.dtype:
    """Training knows no float16."""
    found = options.compute_type
    return torch.float32 if found == torch.float16 else found


def _views(options: CompleteOptions, config: GeoVerseConfig) -> ViewBatch:
    size = options.picture(config)
    return random_views(size, context=options.context, targets=options.targets)


def model_without_numbers(config: GeoVerseConfig) -> GeoVerse:
    """With its video prior; called within ``fake_tensors``."""
    model = GeoVerse(config).eval()
    if config.video is not None:
        model.attach_video(random_video(config.video))
    return model


GB = 1e9


def pass_of(figures: dict[str, Any]) -> str:
    """The network, its views and steps of a table, for the user."""
    size = "x".join(map(str, figures["size"]))
    kept = figures["encoder_interval"]
    encoders = f", encoder interval {kept:g}" if kept else ""
    return (
        f"{figures['config']}, {figures['context']} + {figures['targets']} views of {size}, "
        f"{figures['steps']} + {figures['cascade_steps']} steps{encoders}, {figures['precision']}"
    )


def show_memory(figures: dict[str, Any], console: Console) -> None:
    """Tables of a pass and of a training step in GB (10^9 bytes), and a line about the card."""
    console.line(f"{pass_of(figures)}: peak memory of a pass, GB")
    for model in dict.fromkeys(row["model"] for row in figures["inference"]):
        _show_pass(model, [r for r in figures["inference"] if r["model"] == model], console)
    console.line(f"a training step of one sample, {figures['training_precision']}: peak memory, GB")
    console.table(
        ("stage", "video prior", "recompute", "weights", "lasting", *PARTS, "peak"),
        [
            (
                row["stage"],
                "yes" if row["model"] == WITH else "no",
                "yes" if row["recompute"] else "no",
                row["weights_bytes"] / GB,
                row["lasting_bytes"] / GB,
                *(row[f"{part}_bytes"] / GB for part in PARTS),
                row["total_bytes"] / GB,
            )
            for row in figures["training"]
        ],
    )
    if figures["card_gb"] is not None:
        console.line(card_line(figures, figures["card_gb"]))


def _show_pass(model: str, rows: list[dict[str, Any]], console: Console) -> None:
    weights, prior = rows[0]["weights_bytes"] / GB, rows[0]["video_bytes"] / GB
    beside = f" and {prior:.3g} of the prior's" if prior else ""
    console.line(f"{model}: {weights:.3g} of weights{beside}")
    columns = ("prior leaves", "prior stays") if prior else ("all",)
    console.table(
        ("stage", "activations", *columns),
        [
            (
                row["stage"],
                row["activation_bytes"] / GB,
                row["total_bytes"] / GB,
                *((row["total_bytes_video_stays"] / GB,) if prior else ()),
            )
            for row in rows
        ],
    )


def card_line(figures: dict[str, Any], card: float) -> str:
    """What fits a card of so many GB.

    A card of N GB has N GiB: the 7 % above N 10^9 bytes are left to its driver and to what is lost
    between tensors.
    """
    needs: dict[str, float] = {}
    for row in figures["inference"]:
        name = f"a pass {row['model']}"
        needs[name] = max(needs.get(name, 0.0), row["total_bytes"] / GB)
    for row in figures["training"]:
        if row["recompute"]:
            name = f"training {row['stage']} {row['model']} and with recompute"
            needs[name] = row["total_bytes"] / GB
    parts = (
        f"{name} {'fits' if need <= card else 'does not fit'} ({need:.3g})"
        for name, need in needs.items()
    )
    return f"a card of {card:g} GB: {'; '.join(parts)}"
