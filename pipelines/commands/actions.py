"""Commands of several actions, such as ``gvtools weights list`` and ``gvtools weights check``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from pipelines.console import Console

AddOption = Callable[..., Any]


class Action(NamedTuple):
    """One of them.

    Attributes:
        run: does it.
        add_options: given ``parser.add_argument``.
        summary: one line.
        examples: what follows the action's name.
    """

    run: Callable[[argparse.Namespace, Console], None]
    add_options: Callable[[AddOption], None]
    summary: str
    examples: tuple[str, ...]


def add_actions(parser: argparse.ArgumentParser, command: str, actions: dict[str, Action]) -> None:
    """A parser for each action; ``args.act`` runs the chosen one."""
    parsers = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    for name, action in actions.items():
        lines = "\n".join(f"  gvtools {command} {name} {x}".rstrip() for x in action.examples)
        added = parsers.add_parser(
            name,
            help=action.summary,
            description=f"examples:\n{lines}\n\n{action.summary}.",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        added.set_defaults(act=action.run)
        # As of every command; given before the action they hold as well.
        for option, text in (("quiet", "print nothing but warnings"), ("debug", "tracebacks")):
            added.add_argument(
                f"--{option}", action="store_true", default=argparse.SUPPRESS, help=text
            )
        action.add_options(added.add_argument)
