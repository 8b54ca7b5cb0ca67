"""How likely a depth is right."""

from __future__ import annotations

import torch

# A depth counts as right when its relative error is below this.
RIGHT = 0.05
# Logistic regression of "right" on the features in confidence_of, fitted to kept pixels of the
# sample room (exact depth) and of 7-Scenes kitchen (sensor depth), both counting alike.
WEIGHTS = (-1.077, 0.477, 0.107, -0.711)
BIAS = 2.12
LEAST, MOST = 0.02, 0.99


def confidence_of(cost: torch.Tensor, views: torch.Tensor, spread: torch.Tensor) -> torch.Tensor:
    """Predicted probability that the depth's relative error is below RIGHT.

    Args:
        cost: (H, W) photometric cost in [0, 1].
        views: (H, W) how many other views confirm.
        spread: (H, W) mean relative difference to these.

    Returns:
        (H, W) float32.
    """
    number = views.to(cost.dtype)
    features = torch.stack([cost, number.clamp(max=4), (number >= 2).to(cost.dtype), 100 * spread])
    weights = torch.tensor(WEIGHTS, device=cost.device)
    logit = (features * weights[:, None, None]).sum(0) + BIAS
    return torch.sigmoid(logit).clamp(LEAST, MOST)
