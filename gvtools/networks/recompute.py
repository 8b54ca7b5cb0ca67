"""Activation checkpointing: memory for time in training."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import nn
from torch.utils.checkpoint import checkpoint


class Recomputing(nn.Module):
    """A network whose repeated layers can run a second time in the backward pass.

    Attributes:
        recompute: a layer keeps its inputs alone; everything within it is computed again when its
            gradient is asked for. Results and gradients are the same.
    """

    recompute: bool = False

    def layer(self, run: Callable[..., Any], *inputs: Any) -> Any:
        """``run(*inputs)``, whose activations are kept or not as ``recompute`` says.

        Args:
            run: a layer, without anything random in it.
            inputs: tensors, and what else it takes.
        """
        if not (self.recompute and torch.is_grad_enabled()):
            return run(*inputs)
        return recomputed(run, *inputs)


def recomputed(run: Callable[..., Any], *inputs: Any) -> Any:
    """``run(*inputs)``, of which the inputs alone are kept for the backward pass.

    Args:
        run: without anything random in it.
        inputs: tensors, and what else it takes.
    """
    return checkpoint(run, *inputs, use_reentrant=False, preserve_rng_state=False)


def set_recompute(module: nn.Module, recompute: bool) -> None:
    """Switch every network within ``module`` that knows how."""
    for part in module.modules():
        if isinstance(part, Recomputing):
            part.recompute = recompute
