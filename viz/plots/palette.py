"""Colours and hatches that all figures share, the same for one thing everywhere."""

from __future__ import annotations

# Okabe and Ito's palette, which the common forms of colour blindness tell apart.
BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, RED, PINK = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip
GREY = "#999999"

COLORS = {
    "observed": BLUE,
    "generated": ORANGE,
    "scanned": GREEN,
    "voxels": BLACK,
    "added": GREEN,
    "merged": SKY,
    "rejected": RED,
    "new voxels": GREY,
    "depth": BLUE,
    "fuse": GREEN,
    "project": SKY,
    "complete": ORANGE,
    "align": PINK,
}
HATCHES = {
    "generated": "//",
    "scanned": "..",
    "rejected": "xx",
    "merged": "..",
    "complete": "//",
    "align": "xx",
}
# Of anything that has no colour of its own.
OTHERS = (GREY, RED, BLACK, YELLOW)
