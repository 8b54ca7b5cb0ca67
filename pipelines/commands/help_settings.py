"""The option ``--help-settings``: print every setting of a command, and end."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gvtools.settings import Settings


class HelpSettings(argparse.Action):
    """Like ``--help``, of settings.

    Args:
        settings: makes the defaults, when they are asked for.
        options: of the option, see ``argparse.Action``.
    """

    def __init__(self, *, settings: Callable[[], Settings], **options: Any) -> None:
        super().__init__(**options, nargs=0)
        self._settings = settings

    def __call__(self, parser: argparse.ArgumentParser, *args: object) -> None:
        """Print them to standard output and end the program with status 0."""
        from gvtools.settings import listing

        print(listing(self._settings()))
        parser.exit()
