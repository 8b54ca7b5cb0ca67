"""The protocol on a project: its split of the views, and the run that is then measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError
from gvtools.evaluation.protocol import protocol_split
from gvtools.files import write_json
from gvtools.runs.folder import RunDirectory
from gvtools.runs.layout import RECORD
from gvtools.settings import with_texts, with_values
from pipelines.console import Console
from pipelines.reconstruction.run import reconstruct
from pipelines.reconstruction.settings import RunSettings
from pipelines.report.write import draw_run

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene

# Context and target views of a round, and rounds.
PROTOCOLS = {"pass": (2, 6, 1), "long": (2, 6, 3)}


def run_protocol(
    scene: Scene,
    out: Path,
    *,
    protocol: str,
    stride: int | None,
    seed: int,
    completer: str | None,
    profile: str | None,
    changes: Sequence[str],
    reading: Mapping[str, Any],
    console: Console,
) -> Path:
    """Split the views, run, and write the split beside the run.

    Args:
        scene: the project.
        out: folder for the run and its split.
        protocol: one of PROTOCOLS.
        stride: views from one to the next; None takes the widest.
        seed: of the split and the run.
        completer: its name; None takes the default.
        profile: its name; None takes the default.
        changes: settings as KEY=VALUE.
        reading: how the user said the project is to be read, JSON-ready.
        console: where progress goes.

    Returns:
        The run's folder.
    """
    context, targets, rounds = PROTOCOLS[protocol]
    split = protocol_split(
        scene.names, context=context, targets=targets, rounds=rounds, stride=stride, seed=seed
    )
    start = RunSettings() if profile is None else with_values(RunSettings(), {"profile": profile})
    decided = {
        "context": ",".join(split.context),
        "targets": ",".join(split.targets),
        "views_per_round": targets,
        "rounds": rounds,
        "seed": seed,
        "completer": completer or start.completer,
    }
    config = _with_changes(with_values(start, decided), changes, decided)
    folder = out / "run"
    resume = (folder / RECORD).is_file()
    RunDirectory(folder).refuse_foreign()
    done = reconstruct(
        scene, config, folder, console=console, resume=resume, reading=reading, draw=draw_run
    )
    write_json(out / "split.json", {"protocol": protocol, **split.to_dict()})
    return done


def _with_changes(
    config: RunSettings, changes: Sequence[str], decided: Mapping[str, Any]
) -> RunSettings:
    for text in changes:
        key = text.partition("=")[0].strip()
        if key in decided:
            raise OptionError(f"--set {key}: decided by --protocol; leave it out")
    return with_texts(config, changes)
