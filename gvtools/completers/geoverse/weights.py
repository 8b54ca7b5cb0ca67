"""``GeoVerse`` from a folder and into one, and what precisely does not fit.

A weights folder is one of two: our own (``config.json`` and ``geoverse.safetensors`` with every
tensor), or one of published files as they were downloaded, which make ``gld`` and ``base``. The
video prior lies in ``video/`` of either, and is not needed before a branch of the model is trained
to take its features. Loading and checking both go through ``examine``, so that
what passes the check can be loaded.

Facts about published files (names, sizes, licences, key prefixes) are those of their publishers'
pages and code in November 2026; the shapes come from our own modules, not from the files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse import config as configs
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.denoiser import Denoiser
from gvtools.completers.geoverse.model import GeoVerse, empty_model
from gvtools.completers.geoverse.video_injection import ControlBranch, SharedAttention
from gvtools.completers.geoverse.video_prior import VideoPrior
from gvtools.errors import CheckpointError
from gvtools.files import replaced_when_written
from gvtools.networks.depth_anything import network as da3
from gvtools.networks.tensors import (
    TensorFiles,
    TensorFit,
    compare_tensors,
    load,
    not_finite,
    plain_tensors,
    read_pickled,
    read_tensors,
    save_tensors,
    shapes_alone,
    share_tied,
)

# What GeoVerse adds to published networks.
EXTENSION = ("level1.depth_embedder.", "control.", "shared.")
WHOLE_FILE = da3.GEOVERSE_FILE
CONFIG_FILE = da3.GEOVERSE_CONFIG
VIDEO_FOLDER = "video"
# Of the random numbers of an untrained extension; none of them reaches the output.
_SEED = 0

GLD = "SeonghuJeon/GLD (Geometric Latent Diffusion)"
GLD_TERMS = "Apache-2.0 (model card); code MIT"

# Dictionaries in which the tensors of a PyTorch file may lie; the first that is there counts.
NESTED = ("ema", "model")


@dataclass(frozen=True)
class Part:
    """One file and the module that it fills."""

    name: str
    module: str  # prefix of its keys in the state dict of ``GeoVerse``
    files: tuple[str, ...]  # where it may lie in a weights folder, the publisher's own place first
    source: str  # who publishes it
    licence: str
    strip: str = "module."  # prefix that is taken off every key that has it
    # Keys with none of these prefixes belong to other networks and are ignored; the prefix is taken
    # off as well.
    only: tuple[str, ...] = ()
    # Keys other than these are no tensors of the module and are ignored.
    names: tuple[str, ...] = ()
    # Names that are one tensor in the publisher's network; a file may hold any of them.
    tied: tuple[tuple[str, ...], ...] = ()
    optional: bool = False  # the model can do without it
    # Loaded as its publisher's code does: unknown names are ignored, of a name that is there twice
    # the later counts, and missing tensors keep the values of the part that was loaded before; a
    # message lists them. What does not fit is left out as a whole.
    lenient: bool = False
    # The file's size as published, where it holds other networks, too.
    stated_bytes: int | None = None
    note: str = ""  # what else a user should know

    def find(self, folder: Path) -> Path | None:
        """The part's file in a folder, if it is there."""
        return next((folder / file for file in self.files if (folder / file).is_file()), None)

    def own_name(self, key: str) -> str | None:
        """A stored key by the name of our module, without its prefix; None if it is another's."""
        key = key.removeprefix(self.strip)
        if not self.only:
            return None if self.names and key not in self.names else key
        start = next((start for start in self.only if key.startswith(start)), None)
        return None if start is None else key.removeprefix(start)


# A file of one's own, instead of all others.
WHOLE = Part("geoverse", "", (WHOLE_FILE,), "gvtools train or gvtools weights create", "", strip="")

PARTS = (
    Part(
        "geometry",
        da3.GEOVERSE_PREFIX,
        da3.PUBLISHED_PLACES,
        "depth-anything/DA3-BASE, model.safetensors; also in SeonghuJeon/GLD",
        "Apache-2.0",
        strip=da3.PUBLISHED_PREFIX,
        tied=da3.tied_norms("head."),
        note="the frozen encoder, geometry head, camera encoder and decoder",
    ),
    Part(
        "level1",
        "level1.",
        ("checkpoints/da3_level1.pt", "da3_level1.pt"),
        GLD,
        GLD_TERMS,
        note="the level-1 denoiser; GeoVerse's additions to it start at zero",
    ),
    Part(
        "cascade",
        "cascade.",
        ("checkpoints/da3_cascade.pt", "da3_cascade.pt"),
        GLD,
        GLD_TERMS,
        note="the level-0 cascade",
    ),
    Part(
        "rgb_head",
        "rgb_head.",
        ("pretrained_models/mae_decoder.pt", "mae_decoder.pt"),
        GLD,
        GLD_TERMS,
        only=("decoder.",),
        note="the RGB head",
    ),
    *(
        Part(
            f"statistics{level}",
            f"statistics.{level}.",
            (
                f"model_stats/da3/normalization_stats_level{level}.pt",
                f"normalization_stats_level{level}.pt",
            ),
            "cvlab-kaist/Geometric-Latent-Diffusion, in the code repository",
            "MIT",
            names=("mean", "var"),
            note=f"mean and variance of the level-{level} channels",
        )
        for level in (0, 1)
    ),
)

# Read where it is there, as GLD does: what has a name of the geometry head counts, of a name under
# both prefixes the later; the rest is left aside, tensors that it lacks stay Depth Anything 3's,
# and a file that does not fit is left out.
GEOMETRY_HEAD = Part(
    "geometry_head",
    "geometry.head.",
    ("pretrained_models/da3/dpt_decoder.pt", "da3/dpt_decoder.pt"),
    GLD,
    GLD_TERMS,
    only=("decoder.", "pred."),
    tied=da3.tied_norms(""),
    optional=True,
    lenient=True,
    stated_bytes=470_000_000,
    note="GLD's geometry head, in place of Depth Anything 3's own",
)

VIDEO_SOURCE = "alibaba-pai/Wan2.2-VACE-Fun-A14B, low_noise_model (34.7 GB), cut to 14.8 GB"
VIDEO_TERMS = "Apache-2.0 (repository; check the model card)"
# Tensors, numbers and bytes of what is left of it: blocks 0 to 15, VACE blocks 0, 5, 10 and 15, in
# bfloat16 but for what diffusers keeps in float32; and of the VAE.
VIDEO_SIZES = {
    "transformer": (567, 7_393_674_304, 14_844_078_208),
    "vae": (194, 126_892_531, 507_570_124),
}


def parts_of(config: GeoVerseConfig) -> tuple[Part, ...]:
    """The published parts that a configuration has modules for, the optional one last."""
    parts = (*PARTS, GEOMETRY_HEAD)
    return tuple(part for part in parts if part.name != "cascade" or config.cascade is not None)


def expected_of(module: nn.Module, part: Part) -> dict[str, tuple[int, ...]]:
    """What a part's file has to hold for a (meta) ``GeoVerse``: its module without extensions."""
    own = module.get_submodule(part.module.removesuffix("."))
    return {
        name: tuple(tensor.shape)
        for name, tensor in own.state_dict().items()
        if part is WHOLE or not is_extension(part.module + name)
    }


def is_extension(name: str) -> bool:
    """Whether a key of ``GeoVerse`` is what GeoVerse adds to published networks."""
    return name.startswith(EXTENSION)


def read_part(
    path: Path, part: Part, *, numbers: bool = True
) -> tuple[dict[str, Tensor], tuple[str, ...]]:
    """A part's tensors by the names of our module, and the names of what else its file holds.

    Without ``numbers`` the headers of a safetensors file are read alone.
    """
    content: dict[str, Any] = {}
    if path.suffix == ".safetensors":
        stored = read_tensors(path) if numbers else TensorFiles.find(path).empty()
    else:
        content = read_pickled(path)
        inner = next((content[k] for k in NESTED if isinstance(content.get(k), dict)), content)
        stored = plain_tensors(inner, path)
    found: dict[str, Tensor] = {}
    ignored = []
    for key, tensor in stored.items():
        name = part.own_name(key)
        if name is None:
            ignored.append(key)
        elif name in found and not part.lenient:
            raise CheckpointError(f"{path}: holds {name} twice, also as {key}; expected it once")
        else:
            found[name] = tensor
    if part.name.startswith("statistics"):
        expected, level = int(part.name.removeprefix("statistics")), content.get("level")
        # Of the four levels the last may be called -1.
        if isinstance(level, int) and -4 <= level < 4 and level % 4 != expected:
            raise CheckpointError(f"{path}: statistics of level {level}; expected level {expected}")
        if "var" in found and bool((found["var"] < 0).any()):
            raise CheckpointError(f"{path}: var is negative in places; expected variances")
        found = {name: tensor.reshape(-1) for name, tensor in found.items()}
    share_tied(found, part.tied, where=path)
    return found, tuple(ignored)


@dataclass(frozen=True)
class PartReport:
    """What was found of one part of a folder."""

    name: str
    path: Path | None  # its file or folder
    ok: bool  # it can be loaded, or the model does without it
    summary: str
    fit: TensorFit | None = None  # names, shapes and types, where a file could be read
    bytes: int = 0  # on disk
    parameters: int = 0  # numbers in the tensors that fit
    types: tuple[str, ...] = ()  # what they are stored as
    ignored: tuple[str, ...] = ()  # names in the file that are not looked at
    left_out: bool = False  # it does not fit, and the model does without it

    def to_dict(self) -> dict[str, Any]:
        """For a JSON file."""
        found = asdict(self.fit or TensorFit(0, (), (), (), ()))
        own = {key: value for key, value in vars(self).items() if key != "fit"}
        tensors = found.pop("expected") if self.fit else None
        path = None if self.path is None else str(self.path)
        return {**own, "path": path, "tensors": tensors, **found}


def check_is_folder(folder: Path) -> None:
    """Raises CheckpointError where a weights folder is absent, or a file."""
    if not folder.is_dir():
        found = "is a file" if folder.exists() else "does not exist"
        raise CheckpointError(
            f"{folder} {found}; expected a folder with GeoVerse weights (gvtools weights list)"
        )


def config_of(folder: Path) -> GeoVerseConfig:
    """The folder's own, or that of published files: ``gld``, as which alone they are trained."""
    check_is_folder(folder)
    if (folder / CONFIG_FILE).is_file():
        return configs.read(folder / CONFIG_FILE)
    if (folder / WHOLE_FILE).is_file():
        raise CheckpointError(
            f"{folder}: {WHOLE_FILE} without its {CONFIG_FILE}; expected both; save or copy the "
            "model again"
        )
    config = configs.named("gld")
    if any(part.find(folder) for part in parts_of(config)):
        return config
    raise CheckpointError(
        f"{folder}: neither {CONFIG_FILE} nor a published file in it; gvtools weights list names "
        "what a weights folder holds"
    )


def parts_in(folder: Path, config: GeoVerseConfig) -> tuple[Part, ...]:
    """The files that count: ``geoverse.safetensors`` alone where it is there, else published."""
    return (WHOLE,) if WHOLE.find(folder) else parts_of(config)


def examine(
    folder: Path, part: Part, model: GeoVerse, *, numbers: bool = True
) -> tuple[PartReport, dict[str, Tensor]]:
    """Read one file and compare; the tensors by their names in ``GeoVerse``, if all is well.

    Without ``numbers``, names, shapes and types are looked at alone, which is quick.
    """
    path = part.find(folder)
    if path is None:
        absent = f"absent: neither {WHOLE_FILE} nor {part.files[0]} is there ({part.source})"
        if part.optional:
            absent = f"absent, and not needed: {part.files[0]}, {part.note}"
        return PartReport(part.name, None, part.optional, absent), {}
    size = path.stat().st_size
    try:
        tensors, ignored = read_part(path, part, numbers=numbers)
    except CheckpointError as error:
        summary = str(error).removeprefix(f"{path}: ")
        left_out = part.lenient
        report = PartReport(part.name, path, left_out, summary, bytes=size, left_out=left_out)
        return report, {}
    expected = expected_of(model, part)
    found = compare_tensors(tensors, expected)
    left = {}
    if part.lenient:
        left = {"missing": found.missing, "unexpected": found.unexpected}
        found = replace(found, missing=(), unexpected=())
        tensors = {name: tensor for name, tensor in tensors.items() if name in expected}
    bad = not_finite(tensors) if found.ok and numbers else None
    ok = found.ok and bad is None
    summary = str(found) if bad is None else f"{bad} holds values that are not finite"
    types = sorted({str(t.dtype).removeprefix("torch.") for t in tensors.values()})
    if ok:
        summary += f", {' and '.join(types)}"
    for kind, names in left.items():
        if not names:
            continue
        also = f" and {len(names) - 1} more" if len(names) > 1 else ""
        summary += f"; {kind}, as its publisher's code lets pass: {names[0]}{also}"
    if ignored:
        summary += f"; {len(ignored)} others in the file ignored"
    report = PartReport(
        part.name,
        path,
        ok or part.lenient,
        summary,
        left_out=part.lenient and not ok,
        fit=found,
        bytes=size,
        parameters=sum(t.numel() for n, t in tensors.items() if n in expected),
        types=tuple(types),
        ignored=ignored,
    )
    return report, {part.module + n: tensor for n, tensor in tensors.items()} if ok else {}


def check_folder(folder: Path | str, config: GeoVerseConfig | None = None) -> list[PartReport]:
    """Every part of a folder, looked at without building the model; it loads if all are ``ok``.

    All tensors but the video prior's are read, so that a NaN is found; of that, names and shapes.
    """
    folder = Path(folder)
    check_is_folder(folder)
    config = config or config_of(folder)
    model = empty_model(config, where=folder)
    reports = [examine(folder, part, model)[0] for part in parts_in(folder, config)]
    video, expected = folder / VIDEO_FOLDER, config.video
    if expected is None and video.is_dir() and not (folder / CONFIG_FILE).is_file():
        # Beside published files it waits for a training of ``base``.
        expected = configs.named("base").video
    needed = needs_video(folder, config)
    if expected is not None and not needed and not video.is_dir():
        absent = "absent, and not needed before the branch that takes its features is trained"
        reports.append(PartReport("video", None, True, absent))
    elif expected is not None:
        try:
            check_video_folder(video)
            summary = VideoPrior.from_pretrained(video, config=expected, device="meta").summary
            summary += (
                "" if needed else "; not run: the branch that takes its features is untrained"
            )
            size = sum(path.stat().st_size for path in video.rglob("*.safetensors"))
            reports.append(PartReport("video", video, True, summary, bytes=size))
        except CheckpointError as error:
            path = video if video.exists() else None
            problem = str(error).removeprefix(f"{video}: ")
            reports.append(PartReport("video", path, False, problem))
    return reports


def check_headers(folder: Path | str) -> GeoVerseConfig:
    """The configuration of a folder that can be loaded, as far as headers show; else refused."""
    folder = Path(folder)
    config = config_of(folder)
    _tensors(folder, empty_model(config, where=folder), numbers=False)
    if needs_video(folder, config):
        check_video_folder(folder / VIDEO_FOLDER)
    return config


def left_out(folder: Path, config: GeoVerseConfig) -> str | None:
    """What a user should know of a file that is there and is not loaded, as far as headers show."""
    if WHOLE.find(folder) or GEOMETRY_HEAD.find(folder) is None:
        return None
    model = empty_model(config, where=folder)
    report = examine(folder, GEOMETRY_HEAD, model, numbers=False)[0]
    why = f"{report.path} is left out, Depth Anything 3's own head is used: {report.summary}"
    return why if report.left_out else None


def needs_video(folder: Path, config: GeoVerseConfig) -> bool:
    """Whether a model is to be loaded with its video prior.

    Published files come without the branch that takes its features, and a branch of one's own may
    be untrained: its outputs are then zero, without features the result is the same to the bit,
    and 15 GB are not needed.
    """
    if config.video is None:
        return False
    if config.injection == "control":
        return not _is_zero(folder, "control.outputs.")
    return not (config.shared.gated and _is_zero(folder, "shared.gates"))


def _is_zero(folder: Path, start: str) -> bool:
    """Whether an extension's tensors are zero, as they begin: published files hold none of them."""
    path = WHOLE.find(folder)
    if path is None:
        return True
    files = TensorFiles.find(path)
    names = [name for name in files.places if name.startswith(start)]
    return bool(names) and not any(bool(files.read(name).any()) for name in names)


def untrained_branches(folder: Path, config: GeoVerseConfig) -> tuple[str, ...]:
    """A note for every part of a folder whose branch no training has made useful yet."""
    notes, video = [], folder / VIDEO_FOLDER
    if config.hints.encode == "context":
        files = "published files, " if WHOLE.find(folder) is None else ""
        notes.append(
            f"{folder}: {files}trained without a memory: they complete from the "
            "photographs and the cameras alone, and the memory only keeps what was completed"
        )
    elif config.level1.depth_condition and _is_zero(folder, "level1.depth_embedder."):
        notes.append(f"{folder}: the embedder of projected depth is untrained and has no effect")
    if video.is_dir() and not needs_video(folder, config):
        notes.append(
            f"{video}: neither loaded nor run, as the branch that takes its features is "
            f"untrained; gvtools train base --init {folder} trains it"
        )
    return tuple(notes)


def check_video_folder(folder: Path) -> None:
    """Raises CheckpointError where there is no folder for the video prior."""
    if not folder.is_dir():
        raise CheckpointError(
            f"{folder}: absent; expected the truncated Wan2.2-VACE, which the configuration asks "
            "for; make it with gvtools weights truncate-wan"
        )


def from_pretrained(
    # With ``geoverse.safetensors``, or with published files (``gvtools weights list``).
    folder: Path | str,
    *,
    config: GeoVerseConfig | None = None,  # instead of the folder's own, see ``config_of``
    device: torch.device | str = "cpu",  # of the weights
    # Of the autocast that the model is run in, see ``GeoVerse.hold_in``.
    dtype: torch.dtype = torch.float32,
    # Load the video prior: where it has an effect (``needs_video``), or wherever the configuration
    # has one, as a training needs it, or not.
    video: bool | None = None,
    # Whether its weights leave the device between passes, see ``VideoPrior``.
    offload: str = "auto",
) -> GeoVerse:
    """The model of a weights folder, strictly loaded, in evaluation mode.

    What GeoVerse adds to published files starts untrained, without an effect (``fresh_extension``).
    """
    folder = Path(folder)
    check_is_folder(folder)
    config = config or config_of(folder)
    model = empty_model(config, where=folder)
    wanted, has = video is not False, config.video is not None
    video = has and (needs_video(folder, config) if video is None else video)
    if video:
        check_video_folder(folder / VIDEO_FOLDER)
    tensors = _tensors(folder, model)
    if not WHOLE.find(folder):
        tensors |= fresh_extension(model, tensors)
    # Rounded before they are moved: the device never holds both.
    load(model, tensors, where=folder, device=device if dtype == torch.float32 else "cpu")
    model.freeze()
    model.hold_in(dtype)
    model.to(device).eval()
    if video:
        prior = VideoPrior.from_pretrained(
            folder / VIDEO_FOLDER, config=config.video, device=device, offload=offload
        )
        model.attach_video(prior)
    model.without_video = wanted and has and not video
    return model


def _tensors(folder: Path, model: GeoVerse, *, numbers: bool = True) -> dict[str, Tensor]:
    """All tensors in a folder, by a model's names."""
    loaded: dict[str, Tensor] = {}
    for part in parts_in(folder, model.config):
        report, tensors = examine(folder, part, model, numbers=numbers)
        if not report.ok:
            what = f"{folder}: {report.name}" if report.path is None else f"{report.path}"
            raise CheckpointError(
                f"{what}: {report.summary}; gvtools weights list names what is needed"
            )
        loaded |= tensors
    return loaded


def save_pretrained(
    model: GeoVerse, folder: Path | str, *, dtype: str = "float32", about: str = ""
) -> Path:
    """Write ``config.json`` and ``geoverse.safetensors``, the latter's path is the result.

    Each appears under its name when it is whole, and the weights of an earlier model are never
    beside the configuration of a later one. Of the stored ``dtype`` (one of ``DTYPES``) statistics,
    tables and Fourier frequencies are exempt: rounding would change what the others mean.
    """
    folder = Path(folder)
    path, config_path = folder / WHOLE_FILE, folder / CONFIG_FILE
    with replaced_when_written(config_path) as new_config:
        configs.write(model.config, new_config)
        with replaced_when_written(path) as new_weights:
            tensors = model.state_dict()
            exact = {name for name, _ in model.named_buffers()}
            exact |= {name for name in tensors if name.endswith(".t_embedder.W")}
            words = ", ".join(filter(None, (f"GeoVerse {model.config.name}", about)))
            save_tensors(tensors, new_weights, dtype=dtype, exact=exact, about=words)
            if config_path.is_file() and config_path.read_bytes() != new_config.read_bytes():
                # Should the machine stop between the two names, the folder is not taken for whole.
                config_path.unlink()
    return path


def fresh_extension(model: GeoVerse, loaded: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Untrained extensions, the same at every call; ``loaded`` are the published tensors.

    The output is bit for bit that of the published networks, but for the ungated MoT variant.
    """
    config = model.config
    fresh = {
        name: torch.zeros(tuple(tensor.shape))
        for name, tensor in model.state_dict().items()
        if name.startswith("level1.depth_embedder.")
    }
    if config.video is None:
        return fresh
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(_SEED)
        if model.control is not None:
            level1 = _published_level1(model, loaded)
            control = ControlBranch(config.control, level1, video_channels=config.video.channels)
            fresh |= {f"control.{name}": value for name, value in control.state_dict().items()}
        if model.shared is not None:
            shared = SharedAttention(
                config.shared, config.level1, video_channels=config.video.channels
            )
            fresh |= {f"shared.{name}": value for name, value in shared.state_dict().items()}
    return fresh


def _published_level1(model: GeoVerse, loaded: Mapping[str, Tensor]) -> Denoiser:
    with shapes_alone():
        denoiser = Denoiser(replace(model.config.level1, depth_condition=False))
    tensors = {
        name.removeprefix("level1."): tensor
        for name, tensor in loaded.items()
        if name.startswith("level1.") and not is_extension(name)
    }
    load(denoiser, tensors, where="level1")
    return denoiser
