"""``gvtools data shards`` and ``gvtools data verify``: scenes as WebDataset shards."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError, ProjectError

if TYPE_CHECKING:
    from gvtools.scenes.shard_writer import WrittenShard
    from gvtools.scenes.shards import Skipped
    from pipelines.commands.data import VerifyShards, WriteShards
    from pipelines.console import Console

# Of what could not be converted, so many are named; all are in index.json.
NAMED = 5


def shards(args: WriteShards, console: Console) -> None:
    """Convert scenes to shards, or go on where a conversion stopped."""
    from gvtools.scenes.data_sets.catalogue import spec_names
    from gvtools.scenes.layout import SPEC
    from gvtools.scenes.project import open_collection
    from gvtools.scenes.shard_writer import MEGABYTE, ShardOptions, write_shards
    from gvtools.specs import name_key

    address = args.scenes_of
    if args.root is not None and not address.startswith(SPEC):
        address = SPEC + address
    if args.root is None and not Path(address).exists() and name_key(address) in spec_names():
        raise OptionError(f"{address}: a data set; give the folder of its download by --root DIR")
    collection = open_collection(address, args.root)
    if args.scenes:
        collection = collection.subset(args.scenes)

    def report(done: WrittenShard) -> None:
        shard = done.shard
        at = shard.views[-1].scene + 1
        console.line(
            f"{shard.file}: {len(shard.views)} views, {shard.bytes / MEGABYTE:.1f} MB, up to scene "
            f"{at} of {done.scenes}{' (complete before)' if done.before else ''}"
        )

    options = ShardOptions(args.size, args.max_side)
    index = write_shards(collection, args.out, options=options, progress=report)
    views = sum(scene.views for scene in index.scenes)
    depth = sum(scene.with_depth for scene in index.scenes)
    _warn(index.skipped, console)
    console.line(
        f"{args.out}: {len(index.shards)} shards of {len(index.scenes)} scenes, {views} views, "
        f"{depth} with depth; train from them with data.scenes"
    )


def _warn(skipped: tuple[Skipped, ...], console: Console) -> None:
    for item in skipped[:NAMED]:
        console.warn(f"left out: {item.reason}")
    if len(skipped) > NAMED:
        console.warn(f"left out: {len(skipped) - NAMED} more, listed in index.json")


def verify(args: VerifyShards, console: Console) -> None:
    """Compare shards with their checksums."""
    from gvtools.scenes.shards import read_index
    from gvtools.scenes.shards import verify as problems_of

    problems = problems_of(args.folder)
    count = len(read_index(args.folder).shards)
    if len(problems) > 1:
        for problem in problems:
            console.warn(problem)
    if problems:
        raise ProjectError(problems[0] if len(problems) == 1 else _several(problems, count))
    console.line(f"{args.folder}: {count} shards, all as their checksums say")


def _several(problems: list[str], count: int) -> str:
    return f"{len(problems)} of {count} shards are damaged, first {problems[0]}"
