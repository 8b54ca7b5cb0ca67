"""The list of scenes and stages that ``gvtools fleet`` reads (YAML), and its tasks."""

from __future__ import annotations

import glob
import re
import shlex
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

from gvtools.errors import OptionError
from gvtools.settings import Settings
from gvtools.untrusted import parse_yaml, read_text, reading

# Characters of a list, about 30,000 scenes; more of YAML would take longer than 10 s to read.
LONGEST = 2_000_000
# Placeholders {WORD} that a command may hold, beside the names of earlier stages.
WORDS = ("project", "name", "out")
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


class StageCommand(Settings):
    """A command that is run for every scene."""

    section = "stages"

    command: str
    """What follows ``gvtools``. {project}, {name}, {out} and {STAGE} of an earlier stage stand for
    the scene's input, its name, this stage's folder, and the folder of that stage."""
    cpus: int = Field(1, ge=1)
    """Cores; also the number of threads that the command may use."""
    gpus: float = Field(0, ge=0)
    """GPUs; with a fraction, several commands share one."""
    memory_gb: float = Field(0, ge=0)
    """RAM that the task reserves on Ray and Slurm [GB]; 0 reserves none."""
    retries: int = Field(2, ge=0)
    """How often a command is restarted that was killed, failed with another status than 2 (wrong
    input), or lost its machine."""


class SceneEntry(Settings):
    """One input, or all that match a pattern."""

    section = "scenes"

    project: str
    """A path (relative to the list), a pattern of folders, or an fsspec URL such as s3://."""
    name: str | None = None
    """Name of the results' folder; the last part of ``project`` if not given."""
    labels: dict[str, str] = Field(default_factory=dict)
    """Labels of preferred Ray nodes; while none of these is free, other nodes are used."""


class FleetSpec(Settings):
    """A whole list."""

    section = "fleet"

    stages: dict[str, StageCommand] = Field(min_length=1)
    """In the order in which they run."""
    scenes: tuple[SceneEntry, ...] = Field(min_length=1)
    """What they run on."""


@dataclass(frozen=True)
class Task:
    """One stage of one scene, as any machine can run it."""

    scene: str
    stage: str
    project: str  # path or URL of the input
    command: tuple[str, ...]  # arguments of gvtools, with words in braces
    before: tuple[str, ...]  # earlier stages, which have to be done
    root: str  # path or URL of the fleet's results
    cpus: int  # also the number of threads
    gpus: float
    memory_gb: float
    retries: int
    labels: dict[str, str]  # of preferred nodes

    @property
    def identity(self) -> dict[str, Any]:
        """What decides its result."""
        return {"project": self.project, "command": [*self.command]}

    def record(self, stage: str | None = None) -> str:
        """Where its record lies, or that of another stage of its scene."""
        return f"{self.root}/{self.scene}/{stage or self.stage}.json"


def is_url(text: str) -> bool:
    """Whether a place is an fsspec URL and not a path."""
    return "://" in text


def read_list(path: Path) -> FleetSpec:
    """The list of a file."""
    with reading(path, "expected a list of scenes and stages in YAML"):
        data: Any = parse_yaml(read_text(path), most=LONGEST)
    if not isinstance(data, dict) or not isinstance(data.get("scenes"), list):
        raise OptionError(f"{path}: expected the keys 'stages' and 'scenes', a list")
    entries = [{"project": item} if isinstance(item, str) else item for item in data["scenes"]]
    return FleetSpec(**{**data, "scenes": entries})


def tasks_of(spec: FleetSpec, root: str, *, folder: Path) -> list[Task]:
    """Every stage of every scene, stage by stage; relative paths count from ``folder``."""
    commands = {name: _command(name, spec) for name in spec.stages}
    scenes: dict[str, SceneEntry] = {}
    for entry in spec.scenes:
        for scene in _expanded(entry, folder):
            assert scene.name is not None
            _check_name("scene", scene.name)
            if scene.name in scenes:
                raise OptionError(
                    f"scene {scene.name!r}: {scenes[scene.name].project} and {scene.project} have "
                    "this name; give one of them another 'name'"
                )
            scenes[scene.name] = scene
    names = list(spec.stages)
    return [
        Task(
            scene=name,
            stage=stage,
            project=entry.project,
            command=commands[stage],
            before=tuple(names[: names.index(stage)]),
            root=root,
            labels=entry.labels,
            **{key: getattr(spec.stages[stage], key) for key in StageCommand.model_fields
               if key != "command"},
        )
        for stage in names
        for name, entry in scenes.items()
    ]  # fmt: skip


def _check_name(kind: str, name: str) -> None:
    if not NAME.fullmatch(name) or (kind == "stage" and name in WORDS):
        raise OptionError(f"{kind} {name!r}; expected a name of letters, digits, '.', '_' and '-'")


def _command(name: str, spec: FleetSpec) -> tuple[str, ...]:
    from pipelines.cli import COMMANDS

    _check_name("stage", name)
    text, known = spec.stages[name].command, [word for word in COMMANDS if word != "fleet"]
    try:
        words = shlex.split(text)
    except ValueError:
        words = []
    if not words or words[0] not in known:
        raise OptionError(f"stages.{name}.command {text!r}; expected one of {', '.join(known)}")
    names = list(spec.stages)
    known_words = (*WORDS, *names[: names.index(name)])
    for word in re.findall(r"\{([^{}]*)\}", " ".join(words)):
        if word not in known_words:
            raise OptionError(
                f"stages.{name}.command: {{{word}}} stands for nothing; expected one of "
                f"{', '.join(known_words)}"
            )
    return tuple(words)


def _expanded(entry: SceneEntry, folder: Path) -> list[SceneEntry]:
    if is_url(entry.project):
        name = entry.name or entry.project.rstrip("/").rpartition("/")[2]
        return [entry.replaced(name=name)]
    found: list[str] = []
    with suppress(OSError, RuntimeError, ValueError):  # what no file can have as its name
        path = str((folder / Path(entry.project).expanduser()).absolute())
        found = sorted(place for place in glob.glob(path) if Path(place).is_dir())
        found = [path] if Path(path).exists() else found
    if not found or (len(found) > 1 and entry.name is not None):
        raise OptionError(
            f"scenes: {len(found)} folders fit {entry.project[:80]!r}; expected a path or a "
            "pattern that is there, and a 'name' for one alone"
        )
    return [entry.replaced(project=place, name=entry.name or Path(place).name) for place in found]
