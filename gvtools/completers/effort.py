"""The effort that a view's completion is worth, by the size of its holes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from pydantic import Field

from gvtools.completers.base import Completer, Completion, ContextView, create
from gvtools.guidance import Guidance
from gvtools.settings import Settings


class EffortPolicy(Settings):
    """Less effort for small holes: what stands around them says nearly everything about them."""

    section = "effort"

    inpaint_below: float = Field(0.02, ge=0)
    """Views whose holes have at most this radius, as a share of the image diagonal (see
    ``hole_radius``), are left to ``inpaint`` by a costly completer (geoverse); 0 leaves it none."""

    def wrap(self, completer: Completer) -> Completer:
        """``completer`` under this policy."""
        if self.inpaint_below > 0 and completer.costly:
            return SmallHolesInpainted(completer, self.inpaint_below)
        return completer


class SmallHolesInpainted(Completer):
    """Leaves views whose ``hole_radius`` is at most ``below`` to a cheap completer (``inpaint``).

    Name, files, notes and weights are the costly one's.
    """

    def __init__(self, costly_one: Completer, below: float) -> None:
        super().__init__()
        self.costly_one, self.below = costly_one, below
        self.name = costly_one.name
        self.batches_targets = costly_one.batches_targets

    @property
    def files(self) -> tuple[Path, ...]:
        """The costly one's."""
        return self.costly_one.files

    @property
    def notes(self) -> tuple[str, ...]:
        """The costly one's."""
        return self.costly_one.notes

    @property
    def weights(self) -> Path | None:
        """The costly one's."""
        return self.costly_one.weights

    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """Complete all views, each by one of the two; see ``Completer.complete``."""
        from gvtools.completers.hole_depth import hole_radius  # needs numba

        small = [hole_radius(valid) <= self.below for valid in guidance.valid]

        def parts() -> Iterator[tuple[list[int], Completion]]:
            for completer, cheap in ((create("inpaint"), True), (self.costly_one, False)):
                rows = [row for row, is_small in enumerate(small) if is_small == cheap]
                if rows:
                    yield rows, completer.complete(context, guidance.select(rows), seed=seed)

        return Completion.joined(parts(), guidance.cameras)
