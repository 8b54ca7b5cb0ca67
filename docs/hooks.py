"""Pages that are generated for each build: commands, settings, Python names, data, a gallery."""

from __future__ import annotations

import inspect
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

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


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages and diagrams to those of the folder."""
    # MkDocs restores the path after it has read its hooks.
    sys.path[:0] = [str(ROOT), str(ROOT / "docs")]
    from diagrams import DIAGRAMS, rooms_svg
    from gallery import gallery_files, gallery_page

    pages = {name: _copied(ROOT / source) for name, source in COPIED.items()}
    pages |= {
        "commands.md": commands_page(),
        "settings.md": settings_page(),
        "training-settings.md": training_page(),
        "python.md": python_page(),
        "data.md": data_page(),
        "data_sets.md": data_sets_page(),
        "gallery.md": gallery_page(),
    }
    pages |= {f"images/{name}.svg": diagram.svg() for name, diagram in DIAGRAMS.items()}
    pages["images/architecture.svg"] = rooms_svg()
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    for path in gallery_files():
        files.append(File.generated(config, f"gallery/{path.name}", abs_src_path=str(path)))
    return files


def _copied(source: Path) -> str:
    def link(match: re.Match[str]) -> str:
        target = match[1].removeprefix("../docs/")
        return f"]({RENAMED_LINKS.get(target, target)})"

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
    """Every setting of a run and of completers, by section, and what the profiles change."""
    from gvtools.completers.base import options_of_all
    from gvtools.settings import markdown
    from pipelines.reconstruction.settings import RunSettings

    settings = RunSettings()
    text = [
        "# Settings",
        "",
        "Settings come from the defaults, then `--profile` and `--protocol`, then a JSON file "
        "(`--config`), then the options, then `--set NAME=VALUE`. The resolved ones are written "
        "to `run.json`. A name "
        "that does not exist is an error which names the nearest one. `gvtools reconstruct "
        "--help-settings` prints this list.",
        "",
        markdown(settings, *options_of_all()),
    ]
    for field, presets in settings.presets.items():
        text += [f"## {field.capitalize()}s", ""]
        for name, changes in presets.items():
            changed = ", ".join(f"`{key}={value}`" for key, value in changes.items())
            text.append(f"- `{name}`: {changed or 'the defaults'}")
        text.append("")
    return "\n".join(text) + "\n"


def training_page() -> str:
    """Every setting of a training, with its defaults."""
    from gvtools.settings import markdown
    from gvtools.training.options import TrainingSettings

    text = [
        "# Training settings",
        "",
        "`gvtools train CONFIG` takes a training that ships or a JSON file, then `--set "
        "NAME=VALUE`. `gvtools train CONFIG --help-settings` prints these with the values of that "
        "training.",
        "",
        markdown(TrainingSettings()),
    ]
    return "\n".join(text) + "\n"


def python_page() -> str:
    """The public names with their signatures and docstrings."""
    import gvtools

    text = ["# Python", "", "What `import gvtools` offers.", ""]
    for name in gvtools._SOURCES:
        value = getattr(gvtools, name)
        text += [f"## {name}", "", "```text"]
        try:
            signature = re.sub(r"(: |-> )'([^']*)'", r"\1\2", str(inspect.signature(value)))
            text.append(f"gvtools.{name}{signature}")
        except (TypeError, ValueError):
            text.append(f"gvtools.{name}")
        text += ["", inspect.getdoc(value) or "", ""]
        if inspect.isclass(value) and not issubclass(value, Exception):
            text += _members(value)
        text += ["```", ""]
    return "\n".join(text)


def _members(kind: type) -> Iterator[str]:
    """The public methods and properties of a class and its bases, a line each."""
    members = {name: entry for base in reversed(kind.__mro__) for name, entry in vars(base).items()}
    for name, member in members.items():
        member = getattr(member, "__func__", member)  # of static and class methods
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


def data_sets_page() -> str:
    """The public data sets, from their specs: a table, then all that is known of each."""
    from pipelines.data_sets.downloads import COLUMNS, all_specs, as_yaml, table_rows

    folder = ROOT / "data_specs" / "data_sets"
    text = [(folder / "README.md").read_text(encoding="utf-8"), "## All of them", ""]
    text += [f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS)]
    for row in table_rows():
        text.append(f"| {' | '.join(cell or '' for cell in row)} |")
    text += ["", "## What is known of each", ""]
    for spec in all_specs():
        text += [f"### {spec.name}", "", "```yaml", as_yaml(spec).rstrip(), "```", ""]
    return "\n".join(text)
