"""What ``gvtools weights`` prints of needed files and of checked folders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gvtools.completers.geoverse.config import GeoVerseConfig
    from gvtools.completers.geoverse.weights.folder_parts import PartReport
    from gvtools.completers.geoverse.weights.needed_files import NeededFile, NeededFiles
    from pipelines.console import Console


def print_needed(entry: NeededFiles, console: Console) -> None:
    """The files of a configuration, published ones and one's own."""
    if entry.published:
        console.line(f"{entry.config}, from published files (sizes are approximate):")
        _print_files((*entry.published, *entry.beside), console)
        console.line(f"{entry.config}, in a folder of one's own, instead of the published files:")
        _print_files((entry.own,), console)
    else:
        console.line(f"{entry.config}: nothing of its size is published; a folder of one's own:")
        _print_files((entry.own, *entry.beside), console)


def _print_files(files: Sequence[NeededFile], console: Console) -> None:
    for file in files:
        figures = [
            "" if file.needed else "optional",
            "" if file.bytes is None else size_text(file.bytes),
            "" if file.tensors is None else f"{file.tensors} tensors",
            "" if file.parameters is None else f"{file.parameters:,} numbers",
            file.licence,
        ]
        console.line(f"  {file.path}")
        console.line(f"      {', '.join(filter(None, figures))}")
        console.line(f"      {file.note}")
        console.line(f"      from {file.source}")


def print_parts(
    folder: Path, config: GeoVerseConfig, parts: Sequence[PartReport], console: Console
) -> None:
    """A line a part, and whether the folder can be loaded."""
    console.line(f"{folder}, configuration {config.name}")
    width = max(len(part.name) for part in parts)
    for part in parts:
        mark = "does not fit" if not part.ok else "ok" if part.path else "absent"
        size = f", {size_text(part.bytes)}" if part.bytes else ""
        where = f" ({part.path.relative_to(folder)}{size})" if part.path else ""
        said = part.said.removeprefix("absent: ").removeprefix("absent, and not needed: ")
        console.line(f"  {part.name.ljust(width)}  {mark}{where}: {said}")
    console.line(f"ok: {'true' if all(part.ok for part in parts) else 'false'}")


def size_text(count: int) -> str:
    """Bytes to three digits, in decimal units."""
    for unit, power in (("GB", 9), ("MB", 6), ("kB", 3)):
        if count >= 10**power:
            return f"{count / 10**power:.3g} {unit}"
    return f"{count} bytes"
