"""The pose probe: where a picture really looks from, found from the picture alone."""

from __future__ import annotations

from gvtools.evaluation.pose_probe.located import Located, PoseSummary, summarise
from gvtools.evaluation.pose_probe.probe import PoseProbe, PoseProbeOptions

__all__ = [
    "Located",
    "PoseProbe",
    "PoseProbeOptions",
    "PoseSummary",
    "summarise",
]
