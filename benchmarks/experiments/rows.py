"""The rows of the experiments' tables: classical fillers, and the generative core by its steps."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.experiments.classical import CLASSICAL, classical
from gvtools.completers.base import Completer, create
from gvtools.completers.geoverse.completer import SHIPPED
from gvtools.completers.geoverse.weights import from_pretrained, save_pretrained

HINTS = "hint features decoded, no denoiser"
FILL = "filled projection alone"
UNSHARED_FILL = f"{FILL}, each target's by itself"
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
        UNSHARED_FILL: geoverse(weights, steps=0, shared_fill=False),
        HINTS: geoverse(weights, steps=0, composition="decoded"),
    }


def geoverse(weights: Path | None, **options: object) -> Completer:
    """The generative core; None takes the weights that ship."""
    chosen = {} if weights is None else {"weights": str(weights)}
    return create("geoverse", **chosen, **options)


@contextmanager
def with_heads_of(teacher: Path, student: Path | None) -> Iterator[Path]:
    """A folder with the teacher's denoisers, the student's heads and refiner, while the block runs.

    Heads that are trained after a distillation would otherwise be compared with those before it,
    and their gain be taken for the distillation's.

    Args:
        teacher: the undistilled model's weights.
        student: None for those that ship.
    """
    model, other = from_pretrained(teacher), from_pretrained(student or SHIPPED)
    model.rgb_head.load_state_dict(other.rgb_head.state_dict())
    model.geometry.head.load_state_dict(other.geometry.head.state_dict())
    model.refiner = other.refiner
    model.config = other.config
    with tempfile.TemporaryDirectory() as folder:
        save_pretrained(model, folder)
        yield Path(folder)
