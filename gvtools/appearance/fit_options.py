"""Options of fitting, and how long a fit is worth while."""

from __future__ import annotations

from pydantic import Field

from gvtools.settings import Settings

# A fit whose length is not given takes at most so long [s].
MOST_SECONDS = 120.0
# A fit has converged after so many steps for each photograph, at least CONVERGED_LEAST; with
# recorded depth at least CONVERGED_LEAST_RECORDED, since depth keeps surfaces where they are, so
# that more steps go on helping.
CONVERGED_PER_VIEW, CONVERGED_LEAST, CONVERGED_LEAST_RECORDED = 110, 400, 3000
# Gaussians are added up to PER_STEP for each step of the fit: more are not fitted in time. Without
# recorded depth there are at most PER_VIEW for each photograph: more fit the photographs closely
# and look wrong from other directions.
PER_STEP, PER_VIEW = 65, 8000


class FitOptions(Settings):
    """How Gaussians are fitted to photographs.

    >>> FitOptions().limit, FitOptions(steps=100).limit, FitOptions(seconds=30.0).limit
    (120.0, None, 30.0)
    >>> FitOptions(seconds=0.0).wanted
    False
    """

    section = "refine"

    seconds: float | None = Field(None, ge=0)
    """How long Gaussians are fitted at most, the depth that they begin with included; none: 120, or
    by ``steps``. It ends before, when photographs that are left out gain next to nothing; 0 leaves
    the memory's own colours. [s]"""
    steps: int | None = Field(None, ge=0)
    """How many steps, where no time is given: the same result every time; 0 leaves the memory's own
    colours."""
    init: str | None = None
    """What the fit begins with instead of the project's points or depth: splats, such as another
    program's or an earlier export, or a cloud of points. It is placed like a scan. [FILE]"""
    most_gaussians: int = Field(200_000, ge=1)
    """How many there may be, all fits of a run together; each ``gvtools refine`` may add as many
    again."""
    growth: float = Field(2e-4, gt=0)
    """Gaussians are split or doubled where the mean length of the loss's gradient by their centre
    in the picture (half a picture being 1) is above this; less gives more of them."""
    ssim: float = Field(0.2, ge=0, le=1)
    """Share of structural similarity in the loss; the rest is absolute difference."""
    depth: float = Field(0.1, ge=0)
    """Weight of recorded depth in the loss, by relative difference; 0 ignores it."""
    poses: bool = True
    """Whether poses that pictures contradict, as those of trackers, are refined: before a run,
    also one that fits nothing, and along with the fit."""
    exposure: bool = True
    """Whether each photograph's red, green and blue may be brighter than the others'."""

    @property
    def wanted(self) -> bool:
        """Whether there is time or a step for it."""
        return self.seconds != 0 if self.seconds is not None else self.steps != 0

    @property
    def limit(self) -> float | None:
        """How long they are fitted at most [s]; None counts steps."""
        if self.seconds is None and self.steps is None:
            return MOST_SECONDS
        return self.seconds


def converged_steps(views: int, *, recorded: bool) -> int:
    """After how many steps a fit has converged: more gain next to nothing."""
    return max(
        CONVERGED_PER_VIEW * views, CONVERGED_LEAST_RECORDED if recorded else CONVERGED_LEAST
    )


def most_gaussians(steps: int, views: int, *, recorded: bool) -> int:
    """How many Gaussians a fit of so many steps can do with."""
    return PER_STEP * steps if recorded else min(PER_STEP * steps, PER_VIEW * views)
