"""Pages that are generated for each build: commands, settings, Python names, data, measurements."""

from __future__ import annotations

import inspect
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
# Files of the repository that are pages as they are, with the links that lead elsewhere here.
COPIED = {
    "measurements.md": "benchmarks/README.md",
    "measurements-generative.md": "benchmarks/generative.md",
    "measurements-complete.md": "benchmarks/complete.md",
    "changelog.md": "CHANGELOG.md",
}
RENAMED_LINKS = {"generative.md": "measurements-generative.md"} | {
    "complete.md": "measurements-complete.md",
    "README.md": "measurements.md",
}
BOUNDS = {"ge": "at least", "gt": "more than", "le": "at most", "lt": "less than"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages and diagrams to those of the folder."""
    # MkDocs restores the path after it has read its hooks.
    sys.path[:0] = [str(ROOT), str(ROOT / "docs")]
    from diagrams import DIAGRAMS

    pages = {name: _copied(ROOT / source) for name, source in COPIED.items()}
    pages |= {
        "commands.md": commands_page(),
        "settings.md": settings_page(),
        "python.md": python_page(),
        "data.md": data_page(),
    }
    pages |= {f"images/{name}.svg": diagram.svg() for name, diagram in DIAGRAMS.items()}
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    return files


def _copied(source: Path) -> str:
    def link(match: re.Match[str]) -> str:
        return f"]({RENAMED_LINKS.get(match[1], match[1])})"

    return re.sub(r"\]\(([^)#\s]+)\)", link, source.read_text(encoding="utf-8"))


def commands_page() -> str:
    """Every command's help, as the program prints it."""
    os.environ["COLUMNS"] = "96"
    from pipelines.cli import build_parser

    parser = build_parser()
    action = next(a for a in parser._actions if hasattr(a, "choices") and a.dest == "command")
    text = ["# Commands", "", "```text", parser.format_help(), "```"]
    for name, command in dict(action.choices or {}).items():
        text += ["", f"## gvtools {name}", "", "```text", command.format_help(), "```"]
    return "\n".join(text) + "\n"


def settings_page() -> str:
    """Every setting of a run: its name, type, default, range and meaning."""
    from pipelines.config import PROFILES, RunConfig

    text = [
        "# Settings",
        "",
        "Settings come from the defaults, then `--profile`, then a JSON file (`--config`), then "
        "the options, then `--set NAME=VALUE`. The resolved ones are written to `run.json`. A name "
        "that does not exist is an error which names the nearest one.",
        "",
        "| setting | default | range | meaning |",
        "|---|---|---|---|",
    ]
    text += [f"| `{n}` | `{d}` | {r} | {_cell(doc)} |" for n, d, r, doc in _settings(RunConfig())]
    text += ["", "## Profiles", ""]
    for name, changes in PROFILES.items():
        changed = ", ".join(f"`{key}={value}`" for key, value in changes.items())
        text.append(f"- `{name}`: {changed or 'the defaults'}")
    return "\n".join(text) + "\n"


def _settings(model: Any, prefix: str = "") -> Iterator[tuple[str, Any, str, str]]:
    """Name, default, range and meaning of every field of a settings model, nested ones included."""
    documented = _attributes(model)
    fields = getattr(type(model), "model_fields", None) or type(model).__dataclass_fields__
    for name, entry in fields.items():
        value = getattr(model, name)
        if hasattr(type(value), "model_fields") or hasattr(type(value), "__dataclass_fields__"):
            yield from _settings(value, f"{prefix}{name}.")
            continue
        ends = [
            f"{word} {getattr(item, end):g}"
            for item in getattr(entry, "metadata", ())
            for end, word in BOUNDS.items()
            if getattr(item, end, None) is not None
        ]
        meaning = getattr(entry, "description", None) or documented.get(name, "")
        yield f"{prefix}{name}", value, ", ".join(ends), meaning


def _attributes(model: Any) -> dict[str, str]:
    """The entries of a docstring's section "Attributes"."""
    _, _, section = (inspect.getdoc(type(model)) or "").partition("Attributes:\n")
    entries = re.split(r"^    (?=\w+: )", section, flags=re.MULTILINE)[1:]
    return {name: text for name, _, text in (entry.partition(": ") for entry in entries)}


def _cell(text: str) -> str:
    """Text of a docstring as one cell of a table."""
    return " ".join(text.replace("``", "`").replace("|", "\\|").split())


def python_page() -> str:
    """The public names with their signatures and docstrings."""
    import gvtools

    text = ["# Python", "", "What `import gvtools` offers.", ""]
    for name in gvtools._SOURCES:
        value = getattr(gvtools, name)
        text += [f"## {name}", "", "```text"]
        try:
            text.append(f"gvtools.{name}{inspect.signature(value)}")
        except (TypeError, ValueError):
            text.append(f"gvtools.{name}")
        text += ["", inspect.getdoc(value) or "", ""]
        if inspect.isclass(value) and not issubclass(value, Exception):
            text += _members(value)
        text += ["```", ""]
    return "\n".join(text)


def _members(kind: type) -> Iterator[str]:
    """The public methods and properties that a class itself defines, a line each."""
    for name, member in vars(kind).items():
        member = member.__func__ if isinstance(member, staticmethod) else member
        documented = inspect.getdoc(member)
        if name.startswith("_") or not documented:
            continue
        if inspect.isfunction(member) or isinstance(member, property):
            arguments = "(...)" if inspect.isfunction(member) else ""
            yield f".{name}{arguments}  {documented.splitlines()[0]}"


def data_page() -> str:
    """The layouts that are read and the published tables, from the data specifications."""
    folder = ROOT / "data_specs"
    text = [(folder / "README.md").read_text(encoding="utf-8"), "", "## Layouts", ""]
    for path in sorted(folder.glob("*.yaml")):
        text += [f"### {path.stem}", "", "```yaml", path.read_text(encoding="utf-8"), "```", ""]
    ranges = (folder / "ranges.md").read_text(encoding="utf-8")
    text.append(re.sub(r"^#", "##", ranges, flags=re.MULTILINE))
    return "\n".join(text)
