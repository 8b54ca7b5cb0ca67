"""What an experiment is asked for."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from gvtools.settings import Settings


class ExperimentOptions(Settings):
    """Options of every experiment; each says which it reads."""

    weights: Path | None = None
    """Of the student, or what a training starts from; none takes those that ship. [DIR]"""
    tuned: Path | None = None
    """Weights of ``gvtools train tune``; none leaves their rows out. [DIR]"""
    context: str = "every:20"
    """Views of a recorded scene that are given. [SPEC]"""
    targets: str = "every:20+10"
    """Those that are judged. [SPEC]"""
    teacher: Path | None = None
    """The undistilled model's; none leaves its rows out. [DIR]"""
    scenes: int = Field(64, ge=1)
    """Held-out scenes."""
    size: int | None = Field(None, ge=48)
    """Of the pictures; none for the experiment's own. [px]"""
    seed: int = Field(0, ge=0)
    """Of scenes, noise and training."""
    steps: int = Field(600, ge=1)
    """Of a training within the experiment."""
    out: Path | None = None
    """Folder of what a training within the experiment leaves. [DIR]"""
    project: Path | None = None
    """A recorded scene. [DIR]"""
    projects: tuple[Path, ...] = ()
    """Recorded scenes, of depth or of photographs. [DIR ...]"""
    levels: Path | None = None
    """Folder with the unpacked archives of hand-made levels. [DIR]"""
    pictures: Path | None = None
    """Folder for pictures side by side. [DIR]"""
    training: str = "tiny"
    """The settings of a training within the experiment, see ``gvtools train``. [CONFIG]"""
