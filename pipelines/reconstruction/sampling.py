"""A few of many views, where a few tell enough."""

from __future__ import annotations

from collections.abc import Sequence

# Views that are opened to find a voxel edge, and to tell two readings of a project apart.
SAMPLED_VIEWS = 8


def sampled(names: Sequence[str], count: int = SAMPLED_VIEWS) -> Sequence[str]:
    """At most ``count`` of the names, evenly spread."""
    return names[:: -(-len(names) // count)] if names else names
