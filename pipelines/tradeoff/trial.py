"""One trial: a reconstruction with other settings, measured at the truth's full size."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gvtools.errors import GvError
from gvtools.evaluation.view_figures import view_figures
from gvtools.runs.folder import RunDirectory
from gvtools.runs.round_files import TargetFiles, read_target
from gvtools.scenes.scene import Scene, View
from gvtools.settings import with_values
from pipelines.commands.reconstruct import reconstruct
from pipelines.console import Console, write_json
from pipelines.reconstruction.measure import mean_of
from pipelines.reconstruction.settings import RunSettings
from pipelines.tradeoff.outcome import Outcome


def applied(config: RunSettings, settings: Mapping[str, Any]) -> RunSettings:
    """A run's settings with a trial's; one that names a completer says all of its options."""
    if "completer" in settings:
        config = config.replaced(completer_options={})
    return with_values(config, settings)


class _Silent(Console):
    """Says nothing, warnings included: a sweep's runs are not the user's."""

    def __init__(self) -> None:
        super().__init__(quiet=True)

    def warn(self, text: str) -> None:
        """Nothing."""


class Trials:
    """Runs with changed settings, each made once and kept by what decides it.

    Args:
        scene: the project.
        config: the run that was asked for; its voxel edge is set.
        names: of the target views, held out.
        folder: where outcomes are kept, one JSON file each.
        identity: of that run, see ``run_identity``: other pictures, masks, weights or units are
            other trials.
    """

    def __init__(
        self,
        scene: Scene,
        config: RunSettings,
        names: Sequence[str],
        folder: Path,
        identity: Mapping[str, Any],
    ) -> None:
        self.scene, self.config, self.names, self.folder = scene, config, tuple(names), folder
        self.identity = identity
        self._warm = False

    def outcome(self, settings: Mapping[str, Any], share: float) -> Outcome:
        """The run with these settings on an even share of the targets.

        Raises:
            GvError: the run is refused.
        """
        names = self._names(share)
        kept = self.kept(settings, share)
        if kept is not None:
            return kept
        if not self._warm:
            # Compiled kernels load, and files come into the cache, once.
            self._warm = True
            self._run({}, names[:1])
        found = self._run(settings, names)
        write_json(self._file(settings, names), {"outcome": found.to_json(), "names": names})
        return found

    def kept(self, settings: Mapping[str, Any], share: float) -> Outcome | None:
        """What this trial gave before; None if it was not made, or its file is damaged."""
        file = self._file(settings, self._names(share))
        try:
            return Outcome(**json.loads(file.read_text(encoding="utf-8"))["outcome"])
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def _names(self, share: float) -> list[str]:
        """An even share of the targets."""
        count = max(1, round(share * len(self.names)))
        rows = sorted({round((i + 0.5) * len(self.names) / count - 0.5) for i in range(count)})
        return [self.names[row] for row in rows]

    def _file(self, settings: Mapping[str, Any], names: Sequence[str]) -> Path:
        return self.folder / f"{self._key(settings, names)}.json"

    def _key(self, settings: Mapping[str, Any], names: Sequence[str]) -> str:
        import gvtools

        kept = [field.name for field in fields(Outcome)]
        said = [self.identity, dict(settings), list(names), gvtools.__version__, kept]
        text = json.dumps(said, sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def _run(self, settings: Mapping[str, Any], names: Sequence[str]) -> Outcome:
        config = applied(self.config, settings).replaced(targets=",".join(names))
        out = self.folder / "running"
        shutil.rmtree(out, ignore_errors=True)
        start = time.perf_counter()
        try:
            reconstruct(self.scene, config, out, console=_Silent(), drawn=False)
            whole = time.perf_counter() - start
            directory = RunDirectory(out)
            reports = directory.reports()
            figures = [
                _figures(read_target(directory.round_path(number), entry), self.scene)
                for number, report in enumerate(reports)
                for entry in report["views"]
            ]
        finally:
            shutil.rmtree(out, ignore_errors=True)
        targets = len(figures)
        rounds = sum(report["seconds"]["total"] for report in reports[1:])
        psnr = mean_of(figures, "psnr")
        if psnr is None:
            raise GvError("no target has a true picture to compare with; hold views out")
        return Outcome(
            settings=dict(settings),
            targets=targets,
            fixed=whole - rounds,
            per_target=rounds / targets,
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
