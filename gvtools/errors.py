"""The one exception family. A message says what was found, what was expected, what to do."""

from __future__ import annotations


class GvError(Exception):
    """Base of every error that the user can act upon; the command line ends with status 2."""


class ProjectError(GvError):
    """A project, a file of it, or an output folder is not what it has to be."""


class UnposedError(ProjectError):
    """An input holds pictures and no cameras of them, which ``gvtools capture`` finds.

    Args:
        path: of the input.
        found: what it holds, for the message.
        advice: what to do.

    Attributes:
        found: as given.
    """

    def __init__(self, path: object, found: str, advice: str) -> None:
        super().__init__(f"{path}: {found}; {advice}")
        self.found = found


class OptionError(GvError):
    """An option, a selection or a configuration key is wrong."""


class ShapeError(GvError):
    """An array has the wrong shape or type."""


class DegenerateError(GvError):
    """The numbers do not determine an answer (too few points, no overlap, no spread)."""


class MemoryFileError(GvError):
    """A memory or point-cloud file is damaged, truncated or of an unknown version."""


class CheckpointError(GvError):
    """Network weights are absent or do not fit the configuration."""
