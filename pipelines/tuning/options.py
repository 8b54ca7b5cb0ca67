"""Options of tuning a model to a scene."""

from __future__ import annotations

from pydantic import Field

from gvtools.settings import Settings

# Context views with depth that tuning needs at least: three that predict each other, and a judge.
FEWEST_VIEWS = 4


class TuneOptions(Settings):
    """How long the completer's weights are tuned to the context of a run.

    >>> TuneOptions().wanted, TuneOptions(minutes=2.0).wanted, TuneOptions(steps=0).wanted
    (False, True, False)
    """

    section = "tune"

    minutes: float = Field(0.0, ge=0)
    """How long the completer's network is trained to predict context views from each other, before
    the first targets are completed; 0 takes it as it is. [min]"""
    steps: int | None = Field(None, ge=0)
    """How many optimiser steps instead of a time, which gives the same result every time."""

    @property
    def wanted(self) -> bool:
        """Whether there is time or a step for it."""
        return self.minutes > 0 if self.steps is None else self.steps > 0

    @property
    def length(self) -> str:
        """In words."""
        return f"{self.minutes:g} min" if self.steps is None else f"{self.steps} steps"
