"""One trial: a reconstruction with other settings, measured at the truth's full size."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import gvtools
from gvtools.errors import GvError
from gvtools.evaluation.view_figures import view_figures
from gvtools.files import write_json
from gvtools.runs.folder import RunDirectory
from gvtools.runs.target_files import TargetFiles, read_target
from gvtools.scenes.scene import Scene, View
from gvtools.settings import with_values
from pipelines.console import Console
from pipelines.reconstruction.measure import mean_of
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
        psnr: mean over the targets, dB, whole pictures at their full size.
        ssim: likewise.
        psnr_valid: of pixels that observations support, dB.
        psnr_generated: of generated pixels, dB.
        depth_rel: median relative depth error where the depth is known.
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
    depth_rel: float | None = None


def applied(config: RunSettings, settings: Mapping[str, Any]) -> RunSettings:
    """A run's settings with a trial's; one that names a completer says all of its options."""
    if "completer" in settings:
        config = config.replaced(completer_options={})
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
        config: of the start; its voxel edge is set.
        names: of the target views, held out.
        folder: where trials are kept, one JSON file each.
        identity: of the start, see ``run_identity``: other pictures, masks, weights or units are
            other trials.
    """

    def __init__(
        self,
        scene: Scene,
        config: RunSettings,
        names: Sequence[str],
        *,
        folder: Path,
        identity: Mapping[str, Any],
    ) -> None:
        self.scene, self.config, self.names, self.folder = scene, config, list(names), folder
        self.identity = identity
        self._warm = False

    def make(self, label: str, settings: Mapping[str, Any]) -> Trial:
        """Run with these settings.

        Raises:
            GvError: the run is refused.
        """
        if not self._warm:
            # Kernels are compiled and files are cached once.
            self._warm = True
            self._run(label, {}, self.names[:1])
        trial = self._run(label, settings, self.names)
        write_json(self._file(settings), asdict(trial))
        return trial

    def kept(self, label: str, settings: Mapping[str, Any]) -> Trial | None:
        """What this trial gave before; None if it was not made, or its file is damaged."""
        try:
            trial = Trial(**json.loads(self._file(settings).read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return None
        return replace(trial, label=label)

    def _file(self, settings: Mapping[str, Any]) -> Path:
        parts = [self.identity, dict(settings), self.names, gvtools.__version__]
        text = json.dumps(parts, sort_keys=True, default=str)
        return self.folder / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.json"

    def _run(self, label: str, settings: Mapping[str, Any], names: Sequence[str]) -> Trial:
        config = applied(self.config, settings).replaced(targets=",".join(names))
        out = self.folder / "running"
        shutil.rmtree(out, ignore_errors=True)
        start = time.perf_counter()
        try:
            reconstruct(self.scene, config, out, console=_Silent())
            seconds = time.perf_counter() - start
            directory = RunDirectory(out)
            reports = directory.reports()
            figures = [
                _figures(read_target(directory.round_path(number), entry), self.scene)
                for number, report in enumerate(reports)
                for entry in report["views"]
            ]
        finally:
            shutil.rmtree(out, ignore_errors=True)
        psnr = mean_of(figures, "psnr")
        if psnr is None:
            raise GvError("no target has a true picture to compare with; hold views out")
        return Trial(
            label=label,
            settings=dict(settings),
            seconds=seconds,
            bytes=float(reports[-1]["bytes"]),
            observations=int(reports[-1]["points"]),
            psnr=psnr,
            ssim=mean_of(figures, "ssim"),
            psnr_valid=mean_of(figures, "psnr_valid"),
            psnr_generated=mean_of(figures, "psnr_generated"),
            depth_rel=mean_of(figures, "depth_rel_valid"),
        )


def _figures(target: TargetFiles, scene: Scene) -> dict[str, Any]:
    """Figures of one target, its picture enlarged to the truth's size where the run reduced it."""
    view: View = scene[target.name]
    truth = view.load()
    size = (truth.rgb.shape[1], truth.rgb.shape[0])
    picture, depth = target.picture, target.depth
    observed, generated = target.observed, target.generated
    if picture.shape != truth.rgb.shape:
        picture = np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BILINEAR))
        depth, observed, generated = (
            np.asarray(Image.fromarray(values).resize(size, Image.Resampling.NEAREST))
            for values in (depth, observed, generated)
        )
    return view_figures(picture, truth, observed=observed, generated=generated, depth=depth)
