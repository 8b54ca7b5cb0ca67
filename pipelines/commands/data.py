"""``gvtools data``: data sets as they were downloaded, and shards made of them."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from pipelines.data_sets.shards import shards, shards_options, verify, verify_options

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "convert scenes of data sets to shards for training, and verify shards"
EXAMPLES = (
    "gvtools data shards 7-Scenes --root data/7scenes --out shards/7scenes --max-side 320",
    "gvtools data verify shards/7scenes",
)

# Name: what it does, its options, a summary, examples.
_ACTIONS: dict[str, tuple[Any, ...]] = {
    "shards": (
        shards,
        shards_options,
        "write scenes as WebDataset shards; goes on where it was stopped",
        "7-Scenes --root data/7scenes --out shards/7scenes --max-side 320",
        "scan/ --out shards/scan",
    ),
    "verify": (
        verify,
        verify_options,
        "compare shards with their checksums",
        "shards/7scenes",
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's actions and their options."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    for name, (run_action, add_options, summary, *examples) in _ACTIONS.items():
        lines = "\n".join(f"  gvtools data {name} {example}".rstrip() for example in examples)
        added = actions.add_parser(
            name,
            help=summary,
            description=f"examples:\n{lines}\n\n{summary}.",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        added.set_defaults(act=run_action)
        # As of every command; given before the action they hold as well.
        for option, text in (("quiet", "print nothing but warnings"), ("debug", "tracebacks")):
            added.add_argument(
                f"--{option}", action="store_true", default=argparse.SUPPRESS, help=text
            )
        add_options(added.add_argument)


def run(args: argparse.Namespace, console: Console) -> None:
    """Do what the action says.

    Raises:
        GvError: nothing there, an unknown name, or damaged files.
    """
    args.act(args, console)
