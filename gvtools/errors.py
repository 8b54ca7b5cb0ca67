"""The one exception family. A message says what was found, what was expected, what to do."""

from __future__ import annotations

# Of a message that repeats what a file holds, no more characters than this are shown.
LONGEST = 2000
# Beside control characters: separators of lines, marks that turn the direction of writing.
_UNSEEN = {*range(32), *range(127, 160), 0x2028, 0x2029, *range(0x202A, 0x202F),
           *range(0x2066, 0x206A), *range(0xD800, 0xE000)}  # fmt: skip


def printable(text: str) -> str:
    r"""One line that a terminal shows as it is, whatever names and values of files are in it.

    >>> printable("a\x1b[31m\nb")
    'a\\x1b[31m\\nb'
    """
    if len(text) > LONGEST:
        text = f"{text[: LONGEST * 2 // 3]} [...] {text[-LONGEST // 4 :]}"
    if text.isprintable():
        return text
    shown = (sign if ord(sign) not in _UNSEEN else repr(sign)[1:-1] for sign in text)
    return "".join(shown)


class GvError(Exception):
    """Base of every error that the user can act upon; the command line ends with status 2.

    Its text is one printable line, although messages repeat what files hold.
    """

    def __str__(self) -> str:
        return printable(super().__str__())


class ProjectError(GvError):
    """A project, a file of it, or an output folder is not what it has to be."""


class UnposedError(ProjectError):
    """An input holds pictures and no cameras of them, which ``gvtools capture`` finds.

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
