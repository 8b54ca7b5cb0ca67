"""One trial: a reconstruction with other settings, measured on held-out views."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gvtools
from gvtools.errors import GvError
from gvtools.files import write_json
from gvtools.runs.folder import RunDirectory
from gvtools.runs.layout import METRICS
from gvtools.scenes.scene import Scene
from gvtools.settings import with_values
from gvtools.training.tune_options import TuneOptions
from gvtools.untrusted import read_json
from pipelines.console import Console
from pipelines.reconstruction.run import reconstruct
from pipelines.reconstruction.settings import RunSettings


@dataclass(frozen=True, kw_only=True)
class Trial:
    """What a run with some settings takes and gives.

    Attributes:
        label: "start", "profile NAME", or the setting that it changes.
        settings: by which it differs from the start.
        seconds: of the run.
        bytes: of the memory at the end.
        observations: stored at the end.
        psnr: mean over the targets, dB, whole pictures.
        ssim: likewise.
        psnr_valid: of pixels that observations support, dB.
        psnr_generated: of generated pixels, dB.
        depth_rel_valid: median relative depth error where the depth is known.
    """

    label: str
    settings: dict[str, Any]
    seconds: float
    bytes: float
    observations: int
    psnr: float
    ssim: float | None = None
    psnr_valid: float | None = None
    psnr_generated: float | None = None
    depth_rel_valid: float | None = None


def applied(config: RunSettings, settings: Mapping[str, Any]) -> RunSettings:
    """A run's settings with a trial's; one that names another completer says all of its options."""
    if settings.get("completer", config.completer) != config.completer:
        # Another completer need not have weights to tune.
        config = config.replaced(completer_options={}, tune=TuneOptions())
    return with_values(config, settings)


class _Silent(Console):
    """Prints nothing, warnings included: a sweep's runs are not the user's."""

    def __init__(self) -> None:
        super().__init__(quiet=True)

    def warn(self, text: str) -> None:
        """Nothing."""


class Trials:
    """Runs with changed settings, each made once and kept in a file.

    Args:
        scene: the project.
        config: of the start; its voxel edge is set and its targets are held out.
        folder: where trials are kept, one JSON file each.
        identity: of the start, see ``run_identity``: other pictures, masks, weights or units are
            other trials.
    """

    def __init__(
        self, scene: Scene, config: RunSettings, *, folder: Path, identity: Mapping[str, Any]
    ) -> None:
        self.scene, self.config, self.folder, self.identity = scene, config, folder, identity
        self._warm = False

    def make(self, label: str, settings: Mapping[str, Any]) -> Trial:
        """Run with these settings."""
        if not self._warm:
            # Kernels are compiled and files are cached once.
            self._warm = True
            self._run(label, {"rounds": 1})
        trial = self._run(label, settings)
        write_json(self._file(settings), asdict(trial))
        return trial

    def kept(self, label: str, settings: Mapping[str, Any]) -> Trial | None:
        """What this trial gave before; None if it was not made, or its file is damaged."""
        try:
            data = read_json(self._file(settings))
            return Trial(**data | {"label": label})
        except (OSError, ValueError, TypeError):
            return None

    def _file(self, settings: Mapping[str, Any]) -> Path:
        parts = [self.identity, dict(settings), gvtools.__version__]
        text = json.dumps(parts, sort_keys=True, default=str)
        return self.folder / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.json"

    def _run(self, label: str, settings: Mapping[str, Any]) -> Trial:
        out = self.folder / "running"
        shutil.rmtree(out, ignore_errors=True)
        start = time.perf_counter()
        try:
            reconstruct(self.scene, applied(self.config, settings), out, console=_Silent())
            seconds = time.perf_counter() - start
            report = RunDirectory(out).reports()[-1]
            figures = read_json(out / METRICS)
        finally:
            shutil.rmtree(out, ignore_errors=True)
        if figures["psnr"] is None:
            raise GvError("no target has a true picture to compare with; hold views out")
        names = ("observations", "psnr", "ssim", "psnr_valid", "psnr_generated", "depth_rel_valid")
        return Trial(
            label=label,
            settings=dict(settings),
            seconds=seconds,
            bytes=float(report["bytes"]),
            **{name: figures[name] for name in names},
        )
