"""``gvtools data``: data sets as they were downloaded, and shards made of them.

The actions: list, check, stats, shards, verify.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.commands.arguments import Action, AddOption, add_actions
from pipelines.data_sets.shards import shards, shards_options, verify, verify_options

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "list public data sets, check and sum up a download, make shards of it for training"
EXAMPLES = (
    "gvtools data list",
    "gvtools data check 7-Scenes data/7scenes",
    "gvtools data shards 7-Scenes --root data/7scenes --out shards/7scenes --max-side 320",
)


def _list_options(option: AddOption) -> None:
    option("name", nargs="?", metavar="NAME", help="print all that is known of this one")
    option("--json", type=Path, metavar="FILE", help="write what is known there, with its weight")


def _download_options(option: AddOption) -> None:
    option("name", metavar="NAME", help="of the data set; gvtools data list has them")
    option("root", type=Path, metavar="ROOT", help="the folder of its download, or of a part")
    option(
        "--scene", action="append", default=[], metavar="S", help="this one alone; may be repeated"
    )
    option("--json", type=Path, metavar="FILE", help="write the figures there as well")


def _list(args: argparse.Namespace, console: Console) -> None:
    from pipelines.data_sets.downloads import list_data_sets

    list_data_sets(args, console)


def _check(args: argparse.Namespace, console: Console) -> None:
    from pipelines.data_sets.downloads import check_data_set

    check_data_set(args, console)


def _stats(args: argparse.Namespace, console: Console) -> None:
    from pipelines.data_sets.downloads import statistics_of_data_set

    statistics_of_data_set(args, console)


_ACTIONS = {
    "list": Action(
        _list,
        _list_options,
        "data sets there is a spec of, or all that is known of one",
        ("", "hypersim", "--json data_sets.json"),
    ),
    "check": Action(
        _check,
        _download_options,
        "what of a download can be read, scene by scene; a few views of each are decoded",
        ("7-Scenes data/7scenes", "dl3dv data/dl3dv --scene 1K/0a1b --json check.json"),
    ),
    "stats": Action(
        _stats,
        _download_options,
        "views, baselines, focal lengths and depths of a download",
        ("7-Scenes data/7scenes", "7-Scenes data/7scenes --scene chess/seq-01"),
    ),
    "shards": Action(
        shards,
        shards_options,
        "write scenes as WebDataset shards; goes on where it was stopped",
        (
            "7-Scenes --root data/7scenes --out shards/7scenes --max-side 320",
            "scan/ --out shards/scan",
        ),
    ),
    "verify": Action(
        verify,
        verify_options,
        "compare shards with their checksums",
        ("shards/7scenes",),
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's actions and their options."""
    add_actions(parser, "data", _ACTIONS)


def run(args: argparse.Namespace, console: Console) -> None:
    """Do what the action says."""
    args.act(args, console)
