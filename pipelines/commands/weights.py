"""``gvtools completers`` and ``weights``: what fills holes, and its checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from gvtools.errors import CheckpointError, GvError, OptionError, ProjectError
from pipelines.options import Arguments, JsonArguments

if TYPE_CHECKING:
    from gvtools.completers.geoverse.config import GeoVerseConfig
    from pipelines.console import Console

# What ``list`` calls the networks that give depth alone.
DEPTH = "depth"
# Seconds between two lines of progress.
_INTERVAL = 10.0


class CompletersCommand(JsonArguments):
    """List the completers: what each needs, its cost a view, what it was measured to give."""

    examples = ("gvtools completers", "gvtools completers --json completers.json")

    def run(self, console: Console) -> None:
        from gvtools.completers.base import available, completer_type

        listed = [(name, variant) for name in available() for variant in completer_type(name).facts]
        unsaid = [name for name in available() if not completer_type(name).facts]
        found = [{"name": name, **variant._asdict()} for name, variant in listed]
        self.write_json({"completers": found, "without_figures": unsaid})
        for name, variant in listed:
            console.line(f"{name}{variant.of and f', {variant.of}'}: {variant.what}")
            for field in ("needs", "cost", "gives"):
                console.line(f"  {field.ljust(5)}  {getattr(variant, field)}")
            if variant.source:
                console.line(f"  from   {variant.source}")
        for name in unsaid:
            console.line(f"{name}: of your own; it says nothing of itself (Completer.facts)")
        console.line("gvtools reconstruct PROJECT --completer NAME takes one")


class ListWeights(Arguments):
    """Files, publishers, licences, sizes."""

    examples = ("", "base")
    positional = ("config",)

    config: str | None = None
    """base, gld, tiny or a config.json; all by default. [CONFIG]"""

    def run(self, console: Console) -> None:
        from gvtools.completers.geoverse.config import NAMES
        from pipelines.weights import depth_lines, needed_lines

        names = (DEPTH, *NAMES) if self.config is None else (self.config,)
        for number, name in enumerate(names):
            if number:
                console.line("")
            for line in depth_lines() if name == DEPTH else needed_lines(_config(name)):
                console.line(line)


class FetchWeights(Arguments):
    """Download published weights into a folder; what was interrupted is continued."""

    examples = (
        "gld --to weights/gld",
        "da3-base --to weights/da3 --from 'https://hf-mirror.com/{repo}/resolve/{revision}/{path}'",
    )
    positional = ("model",)

    model: Literal["gld", "da3-small", "da3-base", "da3-large", "wan-vace"]
    """Its published name."""
    to: Path
    """The folder to make or to complete. [DIR]"""
    from_: str = ""
    """Another source than the publishers: a folder that was fetched before, the address of one, or
    an address with {repo}, {revision} and {path}. [URL|DIR]"""
    optional: bool = False
    """Files that the model can do without, too."""

    def run(self, console: Console) -> None:
        from pipelines.published import LICENCES, MODELS, NEXT, fetch
        from pipelines.weights import size_text

        every = MODELS[self.model]
        files = [file for file in every if self.optional or not file.optional]
        total = size_text(sum(file.size for file in files))
        licence = LICENCES.get(self.model, "Apache-2.0")
        console.line(f"{self.model}: {len(files)} files, {total}; licence {licence}")
        for file in every:
            if file not in files:
                console.line(f"{file.place}: left out, not needed (--optional)")
        progress = _progress(console, "fetched")
        fetch(files, self.to, source=self.from_, say=console.line, progress=progress)
        for step in NEXT.get(self.model, NEXT[""]):
            console.line(f"next: {step.replace('DIR', str(self.to))}")


class CheckWeights(JsonArguments):
    """Say precisely what does not fit; encode and decode a photograph."""

    examples = ("weights/base", "DIR --config tiny")
    positional = ("folder",)

    folder: Path
    """A weights folder. [DIR]"""
    config: str | None = None
    """Instead of the folder's own config.json. [NAME|FILE]"""
    photo: Path | None = None
    """To encode and decode; by default one that ships with scikit-image. [FILE]"""

    def run(self, console: Console) -> None:
        from gvtools.completers.geoverse.weights import check_folder, check_is_folder, config_of
        from pipelines.weights import other_revisions, part_lines, self_check

        folder, checked, right = self.folder, "", True
        report: dict[str, Any] = {"folder": str(folder), "config": None, "ok": False, "parts": []}
        try:
            check_is_folder(folder)
            config = config_of(folder) if self.config is None else _config(self.config)
            report["config"] = config.name
            parts = check_folder(folder, config)
        except GvError as error:
            self.write_json({**report, "problem": str(error)})
            raise
        bad = [part for part in parts if not part.ok]
        problem = None
        if bad:
            first = bad[0].name if bad[0].path is None else str(bad[0].path)
            problem = (
                f"{folder}: {len(bad)} of {len(parts)} parts cannot be loaded, first {first}: "
                f"{bad[0].summary}"
            )
        notes = other_revisions(config, parts)
        if not bad:
            checked, right = self_check(folder, config, self.photo)
        if not right:
            notes.append(f"{checked}: the files are damaged, or not of one kind")
        found = [part.to_dict() for part in parts]
        report |= {"self_check": checked, "ok": not bad, "parts": found, "problem": problem}
        if self.write_json({**report, "notes": notes}):
            console.line(f"report written to {self.json_}")
        else:
            head, told = f"{folder}, configuration {config.name}", [checked] if checked else []
            ok = f"ok: {'false' if bad else 'true'}"
            for line in (head, *part_lines(folder, parts), *told, ok):
                console.line(line)
        for note in notes:
            console.warn(note)
        if problem:
            raise CheckpointError(problem)


class CreateWeights(Arguments):
    """Write an untrained model, for tests and as a start of training."""

    examples = ("tiny weights/untrained", "tiny weights/other --seed 1")
    positional = ("config", "folder")

    config: str
    """base, gld, tiny or a config.json. [NAME]"""
    folder: Path
    """The folder to make. [DIR]"""
    seed: int = 0
    """Of the numbers. [N]"""

    def run(self, console: Console) -> None:
        import torch

        from gvtools.completers.geoverse.model import GeoVerse, empty_model
        from gvtools.completers.geoverse.weights import VIDEO_FOLDER, save_pretrained
        from pipelines.weights import size_text

        config, folder = _config(self.config), self.folder
        if folder.is_file() or (
            folder.is_dir() and any(path.name != VIDEO_FOLDER for path in folder.iterdir())
        ):
            raise ProjectError(
                f"{folder} is there already, and not empty; nothing is overwritten; choose another "
                "folder"
            )
        empty_model(config, where=self.config)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            model = GeoVerse(replace(config, trained=False))
        path = save_pretrained(model, folder, about=f"untrained, seed {self.seed}")
        numbers = sum(tensor.numel() for tensor in model.state_dict().values())
        console.line(f"{path}: {numbers:,} numbers, {size_text(path.stat().st_size)}")
        console.line(
            f"this {config.name} model is UNTRAINED (seed {self.seed}): a start for training, and "
            "for tests; what it generates is noise"
        )
        if config.video is not None and not (folder / VIDEO_FOLDER).is_dir():
            console.line(
                f"its training needs the video prior as well: gvtools weights truncate-wan SOURCE "
                f"{folder / VIDEO_FOLDER}"
            )


class PackWeights(Arguments):
    """Write a model in half precision as one file, with the record of a training."""

    examples = (
        "training/tiny weights/tiny",
        "weights/gld weights/packed --dtype bfloat16",
    )
    positional = ("source", "folder")

    source: Path
    """Of gvtools train --out, or a weights folder. [TRAINING|DIR]"""
    folder: Path
    """The folder to make or to renew. [DIR]"""
    dtype: Literal["float16", "bfloat16"] = "float16"
    """What numbers are stored as; bfloat16 has the range of float32."""
    text_encoder: Path | None = None
    """Wan's, for a video prior without the empty prompt; never needed again. [DIR|FILE]"""

    def run(self, console: Console) -> None:
        from gvtools.completers.geoverse.weights import WHOLE_FILE
        from pipelines.weights import pack, size_text

        source = pack(self.source, self.folder, dtype=self.dtype, text_encoder=self.text_encoder)
        size = (self.folder / WHOLE_FILE).stat().st_size
        console.line(f"{self.folder}: {size_text(size)}, from {source}")


class TruncateWan(Arguments):
    """Make the video prior's folder from published Wan2.2-VACE weights."""

    examples = (
        "Wan2.2-VACE-Fun-A14B weights/base/video --vae Wan2.1-VACE-diffusers/vae",
        "Wan2.2-VACE-Fun-14B-diffusers weights/base/video",
    )
    positional = ("source", "folder")

    source: Path
    """The published folder or safetensors file. [SOURCE]"""
    folder: Path
    """The folder to make. [DIR]"""
    vae: Path | None = None
    """Of diffusers or Wan's own; by default beside the transformer. [DIR|FILE]"""
    blocks: int = 16
    """Backbone blocks to keep. [N]"""

    def run(self, console: Console) -> None:
        from gvtools.completers.geoverse.wan import EMPTY_PROMPT
        from gvtools.completers.geoverse.wan_checkpoint import truncate

        progress = _progress(console, "written")
        truncate(self.source, self.folder, blocks=self.blocks, vae=self.vae, progress=progress)
        console.line(
            f"{self.folder} is written; it still needs {EMPTY_PROMPT}: gvtools weights "
            f"empty-prompt TEXT_ENCODER {self.folder}"
        )


class WriteEmptyPrompt(Arguments):
    """Add the empty prompt's embedding to the video prior's folder."""

    examples = (
        "Wan2.2-VACE-Fun-A14B weights/base/video",
        "Wan2.2-VACE-Fun-14B-diffusers/text_encoder weights/base/video",
    )
    positional = ("source", "folder")

    source: Path
    """Wan's text encoder: its file, or a folder with it. [SOURCE]"""
    folder: Path
    """The video prior's folder. [DIR]"""

    def run(self, console: Console) -> None:
        from gvtools.completers.geoverse.wan import EMPTY_PROMPT
        from gvtools.completers.geoverse.wan_checkpoint import write_empty_prompt

        path = self.folder / EMPTY_PROMPT
        if not self.folder.is_dir():
            raise ProjectError(
                f"no folder {self.folder}; make it with gvtools weights truncate-wan"
            )
        if path.exists():
            raise ProjectError(f"{path} is there already; nothing is overwritten")
        write_empty_prompt(self.source, self.folder)
        console.line(f"{path} is written")


class WeightsCommand(Arguments):
    """Tell which weights the generative core needs, and whether a folder of them fits."""

    examples = (
        "gvtools weights list base",
        "gvtools weights check weights/base --json check.json",
    )
    actions: ClassVar = {
        "list": ListWeights, "fetch": FetchWeights, "check": CheckWeights, "create": CreateWeights,
        "pack": PackWeights, "truncate-wan": TruncateWan, "empty-prompt": WriteEmptyPrompt,
    }  # fmt: skip


def _progress(console: Console, what: str) -> Callable[[int, int], None]:
    """Bytes done of all, now and then."""
    from pipelines.weights import size_text

    last = [time.monotonic()]

    def report(done: int, total: int) -> None:
        if done >= total or time.monotonic() - last[0] > _INTERVAL:
            last[0] = time.monotonic()
            console.line(f"{size_text(done)} of {size_text(total)} {what}")

    return report


def _config(name: str) -> GeoVerseConfig:
    """A configuration by its name, or from its file."""
    from gvtools.completers.geoverse.config import NAMES, named, read

    if name in NAMES:
        return named(name)
    path = Path(name)
    if path.is_dir():
        path = path / "config.json"
    if path.is_file():
        return read(path)
    raise OptionError(f"no configuration {name!r}; expected {', '.join(NAMES)} or a config.json")
