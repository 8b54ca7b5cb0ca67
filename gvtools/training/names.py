"""Names of the training's stages, in order."""

from __future__ import annotations

STAGES = ("encoder", "denoiser", "reflow", "heads")
