"""The option ``--help-settings``: print every setting of a command, and end."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gvtools.settings import Settings


class HelpSettings(argparse.Action):
    """Like ``--help``, of settings.

    Args:
        settings: gives the settings of a command and those of its parts, when they are asked for;
            takes what was given on the command line before.
        options: of the option, see ``argparse.Action``.
    """

    def __init__(
        self, *, settings: Callable[[argparse.Namespace], Sequence[Settings]], **options: Any
    ) -> None:
        super().__init__(**options, nargs=0)
        self._settings = settings

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, *args: object
    ) -> None:
        """Print them to standard output and end the program with status 0."""
        from gvtools.errors import GvError
        from gvtools.settings import listing

        try:
            print(listing(*self._settings(namespace)))
        except GvError as error:
            parser.error(str(error))
        parser.exit()
