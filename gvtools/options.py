"""Options that have a range: one wording for every value that lies outside."""

from __future__ import annotations

from gvtools.errors import OptionError


def check_range(
    name: str,
    value: float | None,
    *,
    least: float | None = None,
    above: float | None = None,
    most: float | None = None,
    below: float | None = None,
) -> None:
    """Refuse a number outside its range; None, for options that may be left open, passes.

    Args:
        name: as the user writes it.
        value: what was given.
        least: lower end, included.
        above: lower end, not included.
        most: upper end, included.
        below: upper end, not included.

    Raises:
        OptionError: NaN, or out of the range.
    """
    if value is None:
        return
    ends = {"at least": least, "more than": above, "at most": most, "less than": below}
    kept = (
        (least is None or value >= least)
        and (above is None or value > above)
        and (most is None or value <= most)
        and (below is None or value < below)
    )
    if not kept or value != value:
        wanted = " and ".join(f"{word} {end:g}" for word, end in ends.items() if end is not None)
        raise OptionError(f"{name} {value}; expected {wanted or 'a number'}")
