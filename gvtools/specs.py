"""Specifications of data sets and benchmarks: YAML files of ``data_specs``, found by name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from importlib import resources
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from gvtools.errors import OptionError

Texts = Annotated[tuple[str, ...], Field(strict=False)]


class SpecRecord(BaseModel):
    """Part of a specification: exactly these keys, of exactly these types."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


def spec_texts(folder: str) -> dict[str, str]:
    """The texts of a folder of ``data_specs``, by their files' names."""
    entries = resources.files("data_specs").joinpath(folder).iterdir()
    texts = {x.name[:-5]: x.read_text(encoding="utf-8") for x in entries if x.name[-5:] == ".yaml"}
    return dict(sorted(texts.items()))


def spec_file(what: str, name: str, texts: Mapping[str, str]) -> str:
    """The file's name of a specification, given by that or by its printed name."""
    key = name_key(name)
    for file in texts:
        if name_key(file) == key:
            return file
    raise OptionError(unknown(what, name, texts))


def name_key(text: str) -> str:
    """Letters and digits alone, so that Mip-NeRF 360 is mipnerf360 and ScanNet++ v2 scannetppv2."""
    return "".join(sign for sign in text.casefold().replace("+", "p") if sign.isalnum())


def unknown(what: str, given: str, known: Iterable[str]) -> str:
    """A message that names the nearest of the known names."""
    known = list(known)
    near = difflib.get_close_matches(given, known, n=1)
    near = near or difflib.get_close_matches(name_key(given), known, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(known)}"
    return f"{what} {given!r} is unknown; {hint}"
