"""One trial: a reconstruction with other settings, measured at the truth's full size."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

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
class Outcome:
    """What a run with some settings takes and gives.

    Attributes:
        settings: by which it differs from the start.
        seconds: of the run.
        bytes: of the memory at the end.
        observations: stored at the end.
        psnr: mean over the targets, dB, whole pictures at their full size.
        psnr_valid: of pixels that observations support, dB.
        psnr_generated: of generated pixels, dB.
        ssim: mean over the targets, whole pictures at their full size.
        depth_rel: median relative depth error where the depth is known.
        coverage: share of the pictures that observations support.
    """

    settings: dict[str, Any]
    seconds: float
    bytes: float
    observations: int
    psnr: float
    psnr_valid: float | None
    psnr_generated: float | None
    ssim: float | None
    depth_rel: float | None
    coverage: float | None


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
        folder: where outcomes are kept, one JSON file each.
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

    def outcome(self, settings: Mapping[str, Any]) -> Outcome:
        """The run with these settings.

        Raises:
            GvError: the run is refused.
        """
        kept = self.kept(settings)
        if kept is not None:
            return kept
        if not self._warm:
            # Kernels are compiled and files are cached once.
            self._warm = True
            self._run({}, self.names[:1])
        outcome = self._run(settings, self.names)
        write_json(self._file(settings), asdict(outcome))
        return outcome

    def kept(self, settings: Mapping[str, Any]) -> Outcome | None:
        """What this trial gave before; None if it was not made, or its file is damaged."""
        try:
            return Outcome(**json.loads(self._file(settings).read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return None

    def _file(self, settings: Mapping[str, Any]) -> Path:
        import gvtools

        parts = [self.identity, dict(settings), self.names, gvtools.__version__]
        text = json.dumps(parts, sort_keys=True, default=str)
        return self.folder / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.json"

    def _run(self, settings: Mapping[str, Any], names: Sequence[str]) -> Outcome:
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
        return Outcome(
            settings=dict(settings),
            seconds=seconds,
            bytes=float(reports[-1]["bytes"]),
            observations=int(reports[-1]["points"]),
            psnr=psnr,
            psnr_valid=mean_of(figures, "psnr_valid"),
            psnr_generated=mean_of(figures, "psnr_generated"),
            ssim=mean_of(figures, "ssim"),
            depth_rel=mean_of(figures, "depth_rel_valid"),
            coverage=mean_of(figures, "coverage"),
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
    figures: dict[str, Any] = view_figures(
        picture, truth, observed=observed, generated=generated, depth=depth
    )
    return {**figures, "coverage": float(observed.mean())}
