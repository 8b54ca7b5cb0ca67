"""What the drawing of samples met, in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from gvtools.training.mixture import DRAWN, GEOMETRY_OF, RESAMPLED

# Of the log's keys that count what drawing met: logged, and printed at the end.
NOTE_PREFIXES = tuple(f"{kind}/" for kind in (DRAWN, RESAMPLED, GEOMETRY_OF))


def drawn_lines(counts: Mapping[str, int]) -> Iterator[str]:
    """One line for each source: how many samples, whose geometry, what was invalid and why.

    Args:
        counts: by note, see ``mixture``.

    >>> counts = {"drawn/rooms": 30, "drawn/kitchen": 10, "resampled/kitchen/overlap": 2}
    >>> list(drawn_lines(counts))
    ['10 samples (25 %) of kitchen; drawn again: 2 overlap', '30 samples (75 %) of rooms']
    """
    parts = [(name.split("/", 2), count) for name, count in sorted(counts.items())]
    samples = {part[1]: count for part, count in parts if part[0] == DRAWN}
    total = sum(samples.values())
    for source in sorted({part[1] for part, _ in parts}):
        count = samples.get(source, 0)
        line = f"{count} samples ({count / max(total, 1):.0%}) of {source}".replace("%", " %")
        for kind, title in ((GEOMETRY_OF, "geometry"), (RESAMPLED, "drawn again")):
            found = [f"{n} {part[2]}" for part, n in parts if part[:2] == [kind, source]]
            line += f"; {title}: {', '.join(found)}" if found else ""
        yield line
