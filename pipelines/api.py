"""The two jobs of the command line as functions: ``gvtools.reconstruct``, ``gvtools.evaluate``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gvtools.evaluation.images import Lpips
    from gvtools.runs.run import Run


@dataclass(frozen=True, eq=False)
class RunFigures:
    """What ``evaluate`` measured; a figure that could not be computed is None."""

    coverage: float | None  # mean share of a target's pixels that memory knew before completion
    # Mean over the targets, dB, all pixels; ``details`` has it for observed and for generated
    # pixels alone, by view and by round, with intervals.
    psnr: float | None
    ssim: float | None  # likewise, in [-1, 1]
    lpips: float | None  # likewise; None without the network's weights
    views: int  # number of targets
    # Everything that ``gvtools evaluate`` writes to evaluation.json, by part.
    details: Mapping[str, Any]


def reconstruct(
    project: Path | str,
    out: Path | str,
    *,
    context: str | None = None,
    targets: str | None = None,
    completer: str | None = None,
    profile: str = "balanced",
    settings: Mapping[str, Any] | None = None,
    root: Path | str | None = None,
    resume: bool = False,
    quiet: bool = True,
) -> Run:
    """Grow a memory from a posed project, round by round, as ``gvtools reconstruct`` does.

    Args:
        project: a COLMAP workspace, a posed RGB-D folder, a ``transforms.json``, or
            ``spec:NAME:SCENE`` for a scene of a data set.
        out: the run's folder; new, unless ``resume``.
        context: which views are given, such as ``"every:2"``; None takes all.
        targets: which cameras to complete, such as ``"every:2+1"`` or ``"orbit:24"``; None takes
            twelve between the context views.
        completer: by registered name; None takes ``inpaint``.
        profile: fast, balanced, accurate or finest.
        settings: any setting by its dotted name, such as ``{"voxel": 0.01, "rounds": 2}``.
        root: the folder of the data set's download, where ``project`` is a scene of one.
        resume: continue after the last whole round.
        quiet: False prints progress and figures.

    Returns:
        The finished run: its record, its rounds' reports and its targets' files.

    Raises:
        GvError: wrong input or settings; nothing of an earlier run is lost.
    """
    from gvtools.runs.run import load_run
    from gvtools.scenes.project import open_as
    from gvtools.settings import with_values
    from pipelines.console import Console
    from pipelines.reconstruction.run import reconstruct as run_reconstruct
    from pipelines.reconstruction.settings import RunSettings
    from pipelines.report import draw_run

    config = with_values(RunSettings(), {"profile": profile})
    named = {"context": context, "targets": targets, "completer": completer}
    chosen = {key: value for key, value in named.items() if value is not None}
    config = with_values(config, {**chosen, **(settings or {})})
    reading = {} if root is None else {"root": str(Path(root).resolve())}
    folder = run_reconstruct(
        open_as(Path(project), reading),
        config,
        Path(out),
        console=Console(quiet=quiet),
        resume=resume,
        reading=reading,
        draw=draw_run,
    )
    return load_run(folder)


def evaluate(
    run: Run | Path | str,
    *,
    parts: Sequence[str] = ("images",),
    lpips: Lpips | None = None,
    seed: int = 0,
    quiet: bool = True,
) -> RunFigures:
    """Measure a finished run against the pictures that were held out.

    Args:
        run: as ``load_run`` or ``reconstruct`` returns it, or its folder.
        parts: of "images", "consistency" and "poses".
        lpips: a network for LPIPS.
        seed: of resampling, matching and robust estimates.
        quiet: False prints progress.

    Raises:
        OptionError: an unknown part.
        ProjectError: no run, or its project is gone.
    """
    from gvtools.errors import OptionError
    from gvtools.runs.run import load_run
    from pipelines.console import Console
    from pipelines.scoring.evaluation import evaluate_run
    from pipelines.scoring.measurement import PARTS, MeasureOptions

    unknown = [part for part in parts if part not in PARTS]
    if unknown or not parts:
        raise OptionError(f"parts {tuple(parts)}; expected some of {', '.join(PARTS)}")
    finished = load_run(Path(run)) if isinstance(run, (Path, str)) else run
    absent = None if lpips else "no network was given"
    options = MeasureOptions(parts=parts, lpips=lpips, no_lpips=absent, seed=seed)
    found = evaluate_run(finished, options, console=Console(quiet=quiet))
    mean = found["images"]["mean"] if "images" in found else {}
    psnr, ssim, perceptual = (mean.get(key, {}).get("mean") for key in ("psnr", "ssim", "lpips"))
    return RunFigures(found["coverage"], psnr, ssim, perceptual, found["views"], found)
