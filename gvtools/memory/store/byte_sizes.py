"""Numbers of bytes as people write them."""

from __future__ import annotations

import re

_PREFIXES = " KMGT"
_FORM = re.compile(r"(\d+(?:\.\d+)?)\s*(?:([KMGT])(I?))?B?", re.IGNORECASE)


def bytes_of(text: str) -> int:
    """A number of bytes from text.

    >>> bytes_of("4GB"), bytes_of("1.5 GiB"), bytes_of("1000000")
    (4000000000, 1610612736, 1000000)
    """
    found = _FORM.fullmatch(text.strip())
    if not found:
        raise ValueError("a number of bytes such as 4GB, 400MB or 2GiB")
    power = _PREFIXES.index(found[2].upper()) if found[2] else 0
    return round(float(found[1]) * (1024 if found[3] else 1000) ** power)
