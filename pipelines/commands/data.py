"""``gvtools data``: data sets as they were downloaded, and shards made of them.

The actions: list, check, stats, shards, verify.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.options import Action, Arguments

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "list public data sets, check and sum up a download, make shards of it for training"
EXAMPLES = (
    "gvtools data list",
    "gvtools data check 7-Scenes data/7scenes",
    "gvtools data shards 7-Scenes --root data/7scenes --out shards/7scenes --max-side 320",
)


class ListDataArguments(Arguments):
    """Of ``data list``."""

    positional = ("name",)

    name: str | None = None
    """Print all that is known of this one. [NAME]"""
    json_: Path | None = None
    """Write what is known there, with its weight. [FILE]"""


class DownloadArguments(Arguments):
    """Of ``data check`` and ``data stats``."""

    positional = ("name", "root")

    name: str
    """Of the data set; gvtools data list has them. [NAME]"""
    root: Path
    """The folder of its download, or of a part. [ROOT]"""
    scene: tuple[str, ...] = ()
    """This one alone; may be repeated. [S]"""
    json_: Path | None = None
    """Write the figures there as well. [FILE]"""


class ShardsArguments(Arguments):
    """Of ``data shards``."""

    positional = ("scenes_of",)

    scenes_of: str
    """A data set's name with --root, spec:NAME:SCENE with --root, or a project's folder.
    [NAME|PROJECT]"""
    root: Path | None = None
    """The folder of the data set's download. [DIR]"""
    out: Path
    """The folder of the shards. [DIR]"""
    scenes: tuple[str, ...] = ()
    """Of the data set, by name (all). [SCENE ...]"""
    size: float = 256
    """Of a shard. [MB]"""
    max_side: int | None = None
    """Reduce pictures to this length of their longer side (as they are). [px]"""


class VerifyArguments(Arguments):
    """Of ``data verify``."""

    positional = ("folder",)

    folder: Path
    """A folder of shards. [DIR]"""


def _of(module: str, function: str) -> Callable[[Any, Console], None]:
    """A function of ``pipelines.data_sets`` that is imported when it is called."""

    def run(args: Any, console: Console) -> None:
        getattr(import_module(f"pipelines.data_sets.{module}"), function)(args, console)

    return run


ACTIONS = {
    "list": Action(
        _of("downloads", "list_data_sets"),
        ListDataArguments,
        "data sets there is a spec of, or all that is known of one",
        ("", "hypersim", "--json data_sets.json"),
    ),
    "check": Action(
        _of("downloads", "check_data_set"),
        DownloadArguments,
        "what of a download can be read, scene by scene; a few views of each are decoded",
        ("7-Scenes data/7scenes", "dl3dv data/dl3dv --scene 1K/0a1b --json check.json"),
    ),
    "stats": Action(
        _of("downloads", "statistics_of_data_set"),
        DownloadArguments,
        "views, baselines, focal lengths and depths of a download",
        ("7-Scenes data/7scenes", "7-Scenes data/7scenes --scene chess/seq-01"),
    ),
    "shards": Action(
        _of("shards", "shards"),
        ShardsArguments,
        "write scenes as WebDataset shards; goes on where it was stopped",
        (
            "7-Scenes --root data/7scenes --out shards/7scenes --max-side 320",
            "scan/ --out shards/scan",
        ),
    ),
    "verify": Action(
        _of("shards", "verify"),
        VerifyArguments,
        "compare shards with their checksums",
        ("shards/7scenes",),
    ),
}
