"""How likely a depth is right."""

from __future__ import annotations

import torch

# A depth counts as right when its relative error is below this.
RIGHT = 0.05
# Logistic regression of "right" on the features below, fitted to kept pixels of the sample room
# (exact depth) and of 7-Scenes kitchen (sensor depth), both counting alike.
WEIGHTS = (-1.077, 0.477, 0.107, -0.711)
BIAS = 2.12
LEAST, MOST = 0.02, 0.99


def features(cost: torch.Tensor, views: torch.Tensor, spread: torch.Tensor) -> torch.Tensor:
    """(4, H, W) what the confidence is computed from.

    Args:
        cost: (H, W) photometric cost in [0, 1].
        views: (H, W) how many other views confirm.
        spread: (H, W) mean relative difference to these.
    """
    number = views.to(cost.dtype)
    return torch.stack([cost, number.clamp(max=4), (number >= 2).to(cost.dtype), 100 * spread])


def confidence_of(cost: torch.Tensor, views: torch.Tensor, spread: torch.Tensor) -> torch.Tensor:
    """(H, W) float32 predicted probability that the depth's relative error is below RIGHT."""
    weights = torch.tensor(WEIGHTS, device=cost.device)
    logit = (features(cost, views, spread) * weights[:, None, None]).sum(0) + BIAS
    return torch.sigmoid(logit).clamp(LEAST, MOST)
