"""What a trial gave: time, memory and accuracy, and how they scale to a whole run."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One run of the sweep.

    Attributes:
        settings: by which it differs from the run that was asked for.
        targets: how many it completed.
        fixed: seconds that do not grow with the targets: reading, depth, fusing the context.
        per_target: seconds a target.
        bytes: of the memory at the end.
        observations: stored at the end.
        psnr: mean over its targets, dB, whole pictures at their full size.
        psnr_valid: of pixels that observations support, dB.
        psnr_generated: of pixels that were generated, dB.
        ssim: mean over its targets, whole pictures at their full size.
        depth_rel: median relative depth error of whole pictures' known depth.
        coverage: share of the pictures that observations support.
    """

    settings: dict[str, Any]
    targets: int
    fixed: float
    per_target: float
    bytes: float
    observations: int
    psnr: float
    psnr_valid: float | None
    psnr_generated: float | None
    ssim: float | None
    depth_rel: float | None
    coverage: float | None

    def seconds(self, targets: int) -> float:
        """Of a run with so many targets."""
        return self.fixed + self.per_target * targets

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


def front(outcomes: Iterable[Outcome], cost: Callable[[Outcome], float]) -> list[Outcome]:
    """Those that no other beats in both cost and PSNR, the cheapest first."""
    out: list[Outcome] = []
    for outcome in sorted(outcomes, key=lambda o: (cost(o), -o.psnr)):
        if not out or outcome.psnr > out[-1].psnr:
            out.append(outcome)
    return out
