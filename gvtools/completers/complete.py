"""Completing projected memory in one call, without a run around it."""

from __future__ import annotations

from collections.abc import Sequence

from gvtools.completers.base import Completer, Completion, ContextView, create, run_completer
from gvtools.errors import OptionError
from gvtools.guidance import Guidance


def complete(
    context: Sequence[ContextView],
    guidance: Guidance,
    *,
    completer: str | Completer = "inpaint",
    seed: int = 0,
    **options: object,
) -> Completion:
    """Fill what memory does not know of the target views.

    Args:
        context: observed views that the completer may look at; may be empty.
        guidance: memory projected into the target cameras (``memory.project(cameras)``).
        completer: a registered name ("none", "inpaint", "geoverse", ...), or a completer that was
            made before; make one yourself where it is called often and reads weights.
        seed: the same input and seed give the same bytes on the same machine.
        options: of the completer called by name.

    Raises:
        OptionError: an unknown completer or option, options of a completer that was made before,
            or a completer that breaks its contract.
        ShapeError: views that are damaged or do not fit each other.

    >>> import numpy as np
    >>> from gvtools import Cameras, Guidance
    >>> camera = Cameras.pinhole(64, 48, focal=60.0)
    >>> known = np.ones((1, 48, 64), bool)
    >>> known[:, 20:28, 20:28] = False  # a hole in a grey wall, 2 units away
    >>> weight = known.astype(np.float32)
    >>> wall = Guidance(
    ...     camera, 0.5 * weight[..., None].repeat(3, -1), 2 * weight, known, weight, ~known & False
    ... )
    >>> filled = complete((), wall, completer="inpaint")
    >>> float(filled.depth[0, 24, 24].round(3))
    2.0
    """
    if isinstance(completer, str):
        completer = create(completer, **options)
    elif options:
        raise OptionError(
            f"options {', '.join(options)} beside a completer that was made before; give them to "
            "its class"
        )
    return run_completer(completer, context, guidance, seed=seed)
