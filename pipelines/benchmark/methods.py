"""The methods of a benchmark: settings of gvtools, or pictures that something else made."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError

if TYPE_CHECKING:
    from pipelines.reconstruction.settings import RunSettings

DEFAULT = "default"
PAPER = "paper"
# Names become names of files.
_NAME = re.compile(r"\w[\w+. -]*")


@dataclass(frozen=True, kw_only=True)
class Method:
    """One method.

    Attributes:
        name: in tables and names of files.
        settings: of a run by dotted name, where gvtools makes the pictures.
        pictures: the folder of pictures of another method; None where gvtools makes them.
    """

    name: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    pictures: Path | None = None

    def config(self, *, seconds: float | None) -> RunSettings:
        """The settings of its runs.

        Args:
            seconds: how long Gaussians are fitted, where the method fits any; None leaves it.
        """
        from gvtools.settings import with_values
        from pipelines.reconstruction.settings import RunSettings

        config = with_values(RunSettings(), self.settings)
        if seconds is not None and config.refine.wanted:
            config = with_values(config, {"refine.seconds": seconds})
        return config


def parse_methods(text: str) -> tuple[Method, ...]:
    """Methods with commas between them.

    Each is ``default``, a profile, a completer, ``paper`` (its protocol), ``NAME=FILE.json`` (a
    file of settings) or ``NAME=DIR`` (pictures of another method).
    """
    methods = tuple(_parsed(part.strip()) for part in text.split(",") if part.strip())
    names = [method.name for method in methods]
    if not methods or len(set(names)) < len(names):
        raise OptionError(f"--methods {text!r}; expected at least one, each name once")
    return methods


def _parsed(text: str) -> Method:
    from gvtools.completers.base import available
    from gvtools.evaluation.published import unknown
    from pipelines.reconstruction.settings import RunSettings

    name, equals, path = text.partition("=")
    if equals:
        return _of_path(name.strip(), Path(path.strip()).expanduser())
    if text == DEFAULT:
        return Method(name=text)
    if text == PAPER:
        return Method(name=text, settings={"protocol": "paper"})
    profiles = RunSettings.presets["profile"]
    if text in profiles:
        return Method(name=text, settings={"profile": text})
    if text in available():
        return Method(name=text, settings={"completer": text})
    known = (DEFAULT, PAPER, *profiles, *available())
    raise OptionError(f"{unknown('method', text, known)}; NAME=DIR gives pictures")


def _of_path(name: str, path: Path) -> Method:
    from gvtools.settings import changes, with_file
    from pipelines.reconstruction.settings import RunSettings

    if not _NAME.fullmatch(name):
        raise OptionError(
            f"method {name!r}; expected letters, digits, blanks and + . - _, the first a letter or "
            "a digit"
        )
    if path.is_dir():
        return Method(name=name, pictures=path.resolve())
    if path.suffix != ".json" or not path.is_file():
        raise OptionError(
            f"method {name}={path}: expected a folder of pictures or a JSON file of settings"
        )
    return Method(name=name, settings=changes(RunSettings(), with_file(RunSettings(), path)))
