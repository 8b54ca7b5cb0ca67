"""Why a sample cannot be used, so that another one is drawn and the reason counted."""

from __future__ import annotations

from gvtools.errors import DegenerateError

# A scene cannot be opened, a view cannot be read, views hardly share anything, depth is missing.
SCENE, UNREADABLE, OVERLAP, DEPTH = "scene", "unreadable", "overlap", "depth"


class InvalidSampleError(DegenerateError):
    """A sample that is not to be learnt from.

    Attributes:
        reason: one of the above.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason

    def __reduce__(self) -> tuple[type[InvalidSampleError], tuple[str, str]]:
        # Errors travel from workers to the training.
        return type(self), (self.reason, str(self))
