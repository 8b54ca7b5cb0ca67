"""Parameters, gradients, averages and moments shared out over the processes: torch's FSDP2.

A process holds 1/n of every parameter that is trained, and of the large frozen ones. A transformer
block is put together when it is run and taken apart again; the rest of what is trained, embedders
and outputs, is whole from the beginning of a step to its end.

Processes meet whenever a block is put together, so all of them have to run the same blocks in the
same order. How often the frozen geometric encoder runs depends on the samples: it stays whole.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributed.device_mesh import DeviceMesh, init_device_mesh
from torch.distributed.fsdp import FSDPModule, fully_shard, register_fsdp_forward_method
from torch.distributed.tensor import DTensor, distribute_tensor

from gvtools.completers.geoverse.model import GeoVerse, empty_model
from gvtools.completers.geoverse.video_prior import VideoPrior
from gvtools.networks.tensors import load
from gvtools.training.distributed import Replicated, models_of


class Sharded(Replicated):
    """See the module; the processes' group has to be there, with more than one process."""

    collective = True

    def _distribute(self) -> None:
        mesh = init_device_mesh(self.processes.device.type, (self.processes.count,))
        models = models_of(self.stage)
        networks = {id(model.video): _transformer(model.video) for model in models if model.video}
        for model in models:
            for part in _parts(model):
                fully_shard(part, mesh=mesh)
        for wan in networks.values():
            for block in (*wan.blocks, *wan.vace_blocks):
                fully_shard(block, mesh=mesh)
        # Within the forward of its root, a model's methods may use what that root holds.
        self._root = _as_root(self.stage, mesh)
        teachers = [model for model in models if model not in set(self.stage.children())]
        self._frozen_roots = [_as_root(module, mesh) for module in (*teachers, *networks.values())]
        for teacher in teachers:
            register_fsdp_forward_method(teacher, "velocity1")
        for model in models:
            _move_rest(model, self.processes.device)
        self.about = self._shares([self.stage, *teachers, *networks.values()])

    def _shares(self, modules: Iterable[nn.Module]) -> str:
        parameters = [p for module in modules for p in module.parameters()]
        shared = [p for p in parameters if isinstance(p, DTensor)]
        own = sum(p.to_local().numel() for p in shared)
        whole = sum(p.numel() for p in parameters) - sum(p.numel() for p in shared)
        return (
            f"{self.processes.count} processes share {sum(p.numel() for p in shared):,} parameters "
            f"out, the first holds {own:,} of them; {whole:,} frozen ones are whole in each"
        )

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """The backward pass has averaged them; frozen models forget their part of the step."""
        _settle(self._frozen_roots)

    def number(self, norm: Tensor) -> float:
        """A norm over all parameters."""
        return float(norm.full_tensor() if isinstance(norm, DTensor) else norm)

    @torch.no_grad()
    def gather(self, state: Any) -> Any:
        """Nested dictionaries and lists with whole tensors on the CPU.

        All processes have to call it; only the first one gets tensors.
        """
        if isinstance(state, dict):
            return {name: self.gather(value) for name, value in state.items()}
        if isinstance(state, (list, tuple)):
            return type(state)(self.gather(value) for value in state)
        if not isinstance(state, Tensor):
            return state
        whole = state.full_tensor() if isinstance(state, DTensor) else state
        return whole.detach().cpu() if self.processes.first else None

    def place(self, whole: Tensor, like: Tensor) -> Tensor:
        """What a process holds of a whole tensor, as it does of ``like``."""
        if not isinstance(like, DTensor):
            return whole
        whole = whole.to(like.device)
        return distribute_tensor(whole, like.device_mesh, like.placements, src_data_rank=None)

    @contextmanager
    def usable(self) -> Iterator[None]:
        """Within the block, all processes may use the model outside of the stage's ``forward``."""
        self._root.unshard()
        try:
            yield
        finally:
            _settle([self._root, *self._frozen_roots])

    def whole_model(self, model: GeoVerse) -> GeoVerse | None:
        """A copy with whole tensors on the CPU; all processes have to call it."""
        tensors = self.gather(model.state_dict())
        if not self.processes.first:
            return None
        copy = empty_model(model.config, where="the model in training")
        load(copy, tensors, where="the model in training")
        return copy


def _parts(model: GeoVerse) -> list[nn.Module]:
    """What is put together and taken apart by itself: its forward is called, always as often."""
    found: list[nn.Module] = [model.rgb_head]
    for denoiser in (model.level1, model.cascade, model.control):
        if denoiser is not None:
            found += denoiser.blocks
    encoder = model.geometry.encoder
    if encoder.cls_token.requires_grad:
        found += encoder.blocks
    return found


def _as_root(module: nn.Module, mesh: DeviceMesh) -> FSDPModule:
    """Share out what is trained outside of the parts; what is frozen there stays whole."""
    frozen = {p for p in module.parameters() if not p.requires_grad}
    return fully_shard(module, mesh=mesh, ignored_params=frozen)


def _transformer(prior: VideoPrior) -> Any:
    return prior.networks.transformer


def _move_rest(model: GeoVerse, device: torch.device) -> None:
    """What is not shared out, to a device."""
    modules = [model]
    if model.video is not None:
        model.video.networks.vae.to(device)
        modules.append(model.video.networks.transformer)
    for module in modules:
        for tensor in (*module.parameters(), *module.buffers()):
            if not isinstance(tensor, DTensor):
                tensor.data = tensor.data.to(device)


def _settle(roots: Iterable[FSDPModule]) -> None:
    """Forget forward passes that no backward pass has followed."""
    for root in roots:
        if hasattr(root, "reset_iter_state"):
            root.reset_iter_state()
        else:  # torch before 2.13
            root.reshard()
