"""Tables and sketches that notebooks show of objects."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from html import escape

import numpy as np
from numpy.typing import NDArray

WIDTH = 320  # of a sketch, px


def html_table(title: str, rows: Mapping[str, object], below: str = "") -> str:
    """A title, a line for each name with its value, and HTML below.

    >>> html_table("Memory", {"voxel": 0.02})
    '<b>Memory</b><table><tr><td>voxel</td><td>0.02</td></tr></table>'
    """
    lines = (f"<tr><td>{escape(k)}</td><td>{escape(str(v))}</td></tr>" for k, v in rows.items())
    return f"<b>{escape(title)}</b><table>{''.join(lines)}</table>{below}"


def png_tag(content: bytes) -> str:
    """A PNG file's content as a picture in the page."""
    return f'<img src="data:image/png;base64,{base64.b64encode(content).decode()}">'


def path_sketch(places: NDArray[np.float64]) -> str:
    """An SVG of (N, 3) places along a path, in the plane that it spreads in most."""
    places = places[np.isfinite(places).all(axis=1)]  # Where a tracker was lost it has none.
    if len(places) < 2:
        return ""
    around = places - places.mean(axis=0)
    flat = around @ np.linalg.svd(around[:: max(1, len(around) // 1000)])[2][:2].T
    flat -= flat.min(axis=0)
    flat *= (WIDTH - 8) / max(float(flat.max()), 1e-300)
    height = round(float(flat[:, 1].max())) + 8
    points = " ".join(
        f"{x + 4:.1f},{height - 4 - y:.1f}" for x, y in flat[:: len(flat) // 2000 + 1]
    )
    line = f'<polyline points="{points}" fill="none" stroke="#1f77b4"/>'
    return f'<svg width="{WIDTH}" height="{height}">{line}</svg>'
