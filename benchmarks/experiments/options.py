"""What an experiment is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gvtools.options import check_range


@dataclass(frozen=True, kw_only=True)
class ExperimentOptions:
    """Options of every experiment; each says which it reads.

    Attributes:
        weights: of the student, or what a training starts from; None takes those that ship.
        teacher: the undistilled model's; None leaves its rows out.
        scenes: held-out scenes.
        size: of the pictures, px; None for the experiment's own.
        seed: of scenes, noise and training.
        steps: of a training within the experiment.
        out: folder of what a training within the experiment leaves.
        project: a recorded scene.
        pictures: folder for pictures side by side.
        training: the configuration of a training within the experiment, see ``gvtools train``.
    """

    weights: Path | None = None
    teacher: Path | None = None
    scenes: int = 64
    size: int | None = None
    seed: int = 0
    steps: int = 600
    out: Path | None = None
    project: Path | None = None
    pictures: Path | None = None
    training: str = "tiny"

    def __post_init__(self) -> None:
        check_range("scenes", self.scenes, least=1)
        check_range("size", self.size, least=48)
        check_range("seed", self.seed, least=0)
        check_range("steps", self.steps, least=1)
