"""GeoVerse, the generative core: flow matching in the latents of a frozen geometry model.

Needs torch and numpy alone; weights and the video prior bring in safetensors and diffusers. Start
at ``model.py`` (the whole pass), ``config.py`` (its settings) and ``completer.py`` (its use).
"""

from __future__ import annotations

from gvtools.completers.geoverse.config import GeoVerseConfig, named
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.weights import check_folder, from_pretrained, save_pretrained

__all__ = [
    "GeoVerse",
    "GeoVerseConfig",
    "check_folder",
    "from_pretrained",
    "named",
    "save_pretrained",
]
