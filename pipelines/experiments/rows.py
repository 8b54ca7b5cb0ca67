"""The rows of the experiments' tables: classical fillers, and the generative core by its steps."""

from __future__ import annotations

from pathlib import Path

from gvtools.completers.base import Completer, create
from pipelines.experiments.classical import CLASSICAL, classical

HINTS = "hint features decoded, no denoiser"
FILL = "filled projection alone"
INPAINT = "inpaint (this project's planes)"
# What the core has to beat.
FILLERS = (*CLASSICAL, INPAINT)


def classical_rows() -> dict[str, Completer]:
    """The fillers that a user would otherwise call, and this project's classical completer."""
    rows: dict[str, Completer] = {name: classical(name) for name in CLASSICAL}
    rows[INPAINT] = create("inpaint")
    return rows


def undenoised_rows(weights: Path | None) -> dict[str, Completer]:
    """What the chain gives before any denoising, decoded and as a correction of nothing."""
    return {
        FILL: geoverse(weights, steps=0),
        HINTS: geoverse(weights, steps=0, composition="decoded"),
    }


def geoverse(weights: Path | None, **options: object) -> Completer:
    """The generative core; None takes the weights that ship."""
    chosen = {} if weights is None else {"weights": str(weights)}
    return create("geoverse", **chosen, **options)
