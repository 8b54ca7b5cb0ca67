"""Tensors of a network: found in weights files, read without running code, compared, loaded, saved.

A missing, unexpected or wrongly shaped tensor is always an error, and so is one that holds no
finite floating-point numbers. The safetensors library maps a whole file copy-on-write, which Linux
refuses where the file is larger than the machine's memory, as a published video model is. Here a
tensor's own bytes are read.
"""

from __future__ import annotations

import math
import os
import pickle
import re
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from gvtools.errors import CheckpointError
from gvtools.untrusted import archive, named_file, parse_json, read_json, regular

Shapes = Mapping[str, tuple[int, ...]]

# What is loaded, as float32; quantised numbers mean nothing without their scales.
READABLE = (torch.float32, torch.float16, torch.bfloat16, torch.float64)
# What is written.
DTYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}

# Bytes to a multiple of which torch allocates.
_ALIGNMENT = 64
INDEX = ".safetensors.index.json"
STORED_TYPES = {
    "F64": torch.float64,
    "F32": torch.float32,
    "F16": torch.float16,
    "BF16": torch.bfloat16,
    "F8_E4M3": torch.float8_e4m3fn,
    "F8_E5M2": torch.float8_e5m2,
    "C64": torch.complex64,
    "I64": torch.int64,
    "I32": torch.int32,
    "I16": torch.int16,
    "I8": torch.int8,
    "U8": torch.uint8,
    "BOOL": torch.bool,
}
_ZIP, _PICKLE = b"PK\x03\x04", b"\x80"
# The number that torch.save before PyTorch 1.6 pickled first.
_LEGACY = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19."
_PLACEHOLDER = b"version https://git-lfs"


@dataclass(frozen=True)
class TensorFit:
    """How stored tensors fit expected ones."""

    expected: int  # how many tensors are asked for
    missing: tuple[str, ...]  # names that are asked for and absent
    unexpected: tuple[str, ...]  # names that are there and not asked for
    shape_mismatch: tuple[str, ...]  # "NAME is (2, 3), expected (3, 2)"
    dtype_mismatch: tuple[str, ...] = ()  # "NAME is int64, expected float32, float16, ..."

    @property
    def ok(self) -> bool:
        """Everything that is asked for is there, and nothing else."""
        return not (self.missing or self.unexpected or self.shape_mismatch or self.dtype_mismatch)

    def __str__(self) -> str:
        """One line: what does not fit, the first of each kind by name."""
        if self.ok:
            return f"{self.expected} tensors fit"
        problems = []
        for what, names in (
            ("missing", self.missing),
            ("unexpected", self.unexpected),
            ("of another shape", self.shape_mismatch),
            ("of another type", self.dtype_mismatch),
        ):
            if names:
                more = f" and {len(names) - 1} more" if len(names) > 1 else ""
                problems.append(f"{what}: {names[0]}{more}")
        return f"of {self.expected} tensors " + "; ".join(problems)


_DRAWS = (Tensor.uniform_, Tensor.normal_)


class _NothingDrawn(TorchFunctionMode):
    """Leaves out how new modules fill their tensors, which takes as long on the meta device."""

    def __torch_function__(self, func: Any, types: Any, *given: Any) -> Any:
        """``given``: positional and named arguments, where there are any."""
        args, named = (*given, (), {})[:2]
        if getattr(func, "__module__", None) == "torch.nn.init" or func in _DRAWS:
            return args[0] if args else named["tensor"]
        return func(*args, **(named or {}))


@contextmanager
def shapes_alone() -> Iterator[None]:
    """Modules that are made within have names and shapes, on the meta device, and no numbers."""
    with torch.device("meta"), _NothingDrawn():
        yield


def compare_tensors(stored: Mapping[str, Tensor], expected: Shapes) -> TensorFit:
    """Compare names, shapes and types."""
    found = shapes(stored)
    return TensorFit(
        expected=len(expected),
        missing=tuple(name for name in expected if name not in found),
        unexpected=tuple(name for name in found if name not in expected),
        shape_mismatch=tuple(
            f"{name} is {found[name]}, expected {shape}"
            for name, shape in expected.items()
            if name in found and found[name] != shape
        ),
        dtype_mismatch=tuple(
            f"{name} is {kind}, expected float32, float16, bfloat16 or float64"
            for name, kind in ((name, _kind(stored[name])) for name in expected if name in found)
            if kind
        ),
    )


def _kind(tensor: Tensor) -> str:
    """What a tensor is that cannot be loaded; empty for one that can."""
    if tensor.is_sparse or tensor.layout != torch.strided:
        return "sparse"
    if tensor.is_quantized or tensor.dtype not in READABLE:
        return str(tensor.dtype).removeprefix("torch.")
    return ""


def shapes(tensors: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
    """Name to shape."""
    return {name: tuple(tensor.shape) for name, tensor in tensors.items()}


def check_fit(stored: Mapping[str, Tensor], expected: Shapes, *, where: object) -> None:
    """Refuse tensors (also on the meta device) that are not the expected ones."""
    found = compare_tensors(stored, expected)
    if not found.ok:
        raise CheckpointError(f"{where}: {found}; the file is of another network or version")


def load(
    module: nn.Module,  # may be on the meta device
    tensors: Mapping[str, Tensor],  # by the names of its state dict, all of them
    *,
    where: object,  # what the message names
    device: torch.device | str = "cpu",  # of the module afterwards
) -> None:
    """Put tensors into a module, in float32; what is so already may stay mapped from its file."""
    check_fit(tensors, shapes(module.state_dict()), where=where)
    module.load_state_dict(
        {name: _place(tensor, device) for name, tensor in tensors.items()}, assign=True
    )


def _place(tensor: Tensor, device: torch.device | str) -> Tensor:
    """Contiguous float32 on a device, where torch would have put it."""
    placed = tensor.to(device, torch.float32).contiguous()
    # Products depend on the alignment in their last bit, and that of a file's tensors is by chance.
    return placed.clone() if placed.data_ptr() % _ALIGNMENT else placed


def not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """The first tensor of floating-point numbers that holds a NaN or an infinity."""
    for name, tensor in tensors.items():
        # Both ends are NaN where any number is; one pass, and nothing of the tensor's size is made.
        if tensor.numel() and tensor.is_floating_point():
            ends = torch.stack(torch.aminmax(tensor.detach())).tolist()
            if not all(map(math.isfinite, ends)):
                return name
    return None


def share_tied(
    tensors: dict[str, Tensor], tied: tuple[tuple[str, ...], ...], *, where: object
) -> None:
    """Give tied names their common tensor where a file has it under some of them, in place."""
    for names in tied:
        present = [name for name in names if name in tensors]
        if not present or len(present) == len(names):
            continue
        first = tensors[present[0]]
        for name in present[1:]:
            if not first.is_meta and not torch.equal(tensors[name], first):
                raise CheckpointError(
                    f"{where}: {name} differs from {present[0]}; expected one tensor of all of "
                    f"{names[0]} to {names[-1]}, or every one of them"
                )
        tensors |= dict.fromkeys(names, first)


def save_tensors(
    tensors: Mapping[str, Tensor],  # by name
    file: Path,  # to be written
    *,
    dtype: str = "float32",  # what floating-point tensors are stored as, one of ``DTYPES``
    exact: Collection[str] = (),  # names that keep float32, because rounding them matters
    about: str,  # goes into the file's metadata
) -> None:
    """Write a .safetensors file under the name it is given, flushed to the disk."""
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    if dtype not in DTYPES:
        raise CheckpointError(f"dtype {dtype!r}; expected one of {', '.join(DTYPES)}")
    bad = not_finite(tensors)
    if bad is not None:
        raise CheckpointError(f"{bad} holds values that are not finite; nothing is written")
    stored: dict[str, Tensor] = {}
    places: set[int] = set()
    for name, tensor in tensors.items():
        kind = torch.float32 if name in exact else DTYPES[dtype]
        kept = tensor.detach().to("cpu", kind if tensor.is_floating_point() else tensor.dtype)
        kept = kept.contiguous()
        # Two views of one memory cannot be stored as they are.
        stored[name] = kept.clone() if kept.untyped_storage().data_ptr() in places else kept
        places.add(stored[name].untyped_storage().data_ptr())
    bad = not_finite(stored)
    if bad is not None:
        raise CheckpointError(
            f"{bad} reaches {float(tensors[bad].abs().max()):.3g}, too large for {dtype}; use "
            "bfloat16 or float32; nothing is written"
        )
    # The library gives its files to their owner alone; these get what the folder's others have.
    file.touch()
    mode = file.stat().st_mode
    try:
        # The library writes several entries in random order, and the same model as other bytes.
        save_file(stored, str(file), metadata={"about": about})
    except SafetensorError as error:
        raise OSError(str(error)) from error
    file.chmod(mode)
    with file.open("rb+") as written:
        os.fsync(written.fileno())


class _Entry(NamedTuple):
    """Where a tensor begins, bytes of the file, and the tensor without its numbers."""

    start: int
    empty: Tensor


class TensorFiles:
    """The tensors of one network, in one safetensors file or in several with an index.

    ``places``: file and stored name of each, by the name it is asked for. Only headers are read
    until ``read`` is called, and a file in which no tensor is asked for need not even be there.
    """

    def __init__(self, places: Mapping[str, tuple[Path, str]]) -> None:
        self.places = dict(places)
        self._headers: dict[Path, dict[str, _Entry]] = {}

    @classmethod
    def find(cls, place: Path) -> TensorFiles:
        """Of a safetensors file, or of the one network in a folder."""
        if not place.is_dir():
            return cls({name: (place, name) for name in _read_header(place)})
        for pattern in (f"*{INDEX}", "*.safetensors"):
            found = sorted(place.glob(pattern))
            if len(found) > 1:
                raise CheckpointError(
                    f"{place}: {len(found)} times {pattern} ({found[0].name}, {found[1].name}, "
                    "...); expected one network, or name its file"
                )
            if found and pattern == f"*{INDEX}":
                index = _read_index(found[0])
                return cls(
                    {
                        name: (named_file(place, file, where=str(found[0])), name)
                        for name, file in index.items()
                    }
                )
            if found:
                return cls.find(found[0])
        raise CheckpointError(f"{place}: no *.safetensors; expected a network's weights there")

    @property
    def paths(self) -> list[Path]:
        """The files themselves."""
        return sorted({path for path, _ in self.places.values()})

    def renamed(self, stored: Mapping[str, str]) -> TensorFiles:
        """The same tensors by other names: ``stored`` is today's name of each new one."""
        return TensorFiles({name: self.places[old] for name, old in stored.items()})

    def empty(self, names: Iterable[str] | None = None) -> dict[str, Tensor]:
        """Shapes and types, on the meta device; of ``names`` those that are there, None for all."""
        asked = self.places if names is None else names
        return {name: self._entry(name).empty for name in asked if name in self.places}

    def read(self, name: str, *, device: str = "cpu") -> Tensor:
        """One tensor, as stored."""
        path = self.places[name][0]
        start, empty = self._entry(name)
        content = torch.empty(empty.nbytes, dtype=torch.uint8)
        with regular(path).open("rb") as file:
            file.seek(start)
            if file.readinto(memoryview(content.numpy())) != len(content):  # type: ignore[arg-type]
                raise CheckpointError(f"{path}: ends within {name}; download it again")
        return content.view(empty.dtype).reshape(empty.shape).to(device)

    def _entry(self, name: str) -> _Entry:
        path, stored = self.places[name]
        if path not in self._headers:
            self._headers[path] = _read_header(path)
        if stored not in self._headers[path]:
            raise CheckpointError(f"{path}: no {stored}, which its index puts there")
        return self._headers[path][stored]


def _read_header(path: Path) -> dict[str, _Entry]:
    """What a safetensors file holds: the header's length, the header in JSON, tensors' bytes."""
    _check_is_whole(path)
    try:
        with regular(path).open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            if length > path.stat().st_size:
                raise ValueError(f"a header of {length} bytes")
            stored = parse_json(file.read(length))
        stored.pop("__metadata__", None)
        header, parts = {}, []
        for name, value in stored.items():
            start, end = value["data_offsets"]
            if value["dtype"] not in STORED_TYPES:
                raise ValueError(f"{name} is {value['dtype']}, which is not known here")
            dtype = STORED_TYPES[value["dtype"]]
            empty = torch.empty(value["shape"], dtype=dtype, device="meta")
            if not isinstance(start, int) or start < 0 or end - start != empty.nbytes:
                raise ValueError(f"{name} has {end - start} bytes for {value['shape']}")
            header[name] = _Entry(8 + length + start, empty)
            parts.append((start, end))
        last = 0
        for start, end in sorted(parts):
            if start != last:
                raise ValueError(f"a tensor begins at byte {start}, the one before ends at {last}")
            last = end
        size = path.stat().st_size - 8 - length
        if last != size:
            raise ValueError(f"{size} bytes of tensors, {last} by its header")
    except Exception as error:
        # What a damaged header holds in place of numbers fails in many ways.
        raise CheckpointError(
            f"{path}: cannot be read ({first_line(error)}); expected a whole safetensors file; "
            "download it again"
        ) from None
    return header


def _read_index(path: Path) -> dict[str, str]:
    try:
        index = dict(read_json(path)["weight_map"])
        if not all(isinstance(file, str) for file in index.values()):
            raise ValueError("a file's name that is no text")
        return index
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(
            f"{path}: cannot be read ({error}); expected an index of safetensors files"
        ) from error


def read_tensors(path: Path) -> dict[str, Tensor]:
    """All tensors of a .safetensors, .pt or .pth file by their stored names."""
    if path.suffix == ".safetensors":
        files = TensorFiles.find(path)
        return {name: files.read(name) for name in files.places}
    return plain_tensors(read_pickled(path), path)


def plain_tensors(content: Mapping[Any, Any], path: Path) -> dict[str, Tensor]:
    """The tensors of a dictionary; scalars beside them are ignored, other objects are refused."""
    tensors = {}
    for name, value in content.items():
        if not isinstance(name, str) or not isinstance(
            value, (Tensor, int, float, str, bool, type(None))
        ):
            raise CheckpointError(
                f"{path}: {name!r} is a {type(value).__name__}; expected tensors by name"
            )
        if isinstance(value, Tensor):
            tensors[name] = value
    return tensors


def read_pickled(path: Path, *, legacy: bool = False) -> dict[str, Any]:
    """The dictionary of a .pt file, its tensors mapped from disk where they are in zip form.

    ``legacy`` also takes the form that torch.save wrote before PyTorch 1.6, without running code.
    """
    start = _check_is_whole(path)
    zipped = start.startswith(_ZIP)
    if not zipped and not (legacy and start.startswith(_LEGACY)):
        bare = start.startswith(_PICKLE)
        found = "a bare pickle, which may hold code" if bare else "no PyTorch file"
        raise CheckpointError(
            f"{path}: {found}; expected the zip form that torch.save writes since PyTorch 1.6, "
            "with tensors alone; download it again"
        )
    try:
        with warnings.catch_warnings():
            # About the protocol and deprecated classes of damaged files; what follows says more.
            warnings.simplefilter("ignore")
            if zipped:
                with archive(path):
                    pass  # its members claim what they may
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=zipped)
    except pickle.UnpicklingError as error:
        raise CheckpointError(f"{path}: {_refused(error)}; nothing of it was run") from None
    except Exception as error:
        # What torch's reader stumbles upon in a damaged file, it raises as it comes.
        raise CheckpointError(
            f"{path}: cannot be read ({first_line(error)}); expected a whole PyTorch file of "
            "tensors; download it again"
        ) from None
    if not isinstance(content, dict):
        raise CheckpointError(
            f"{path}: holds a {type(content).__name__}; expected a dictionary of tensors by name"
        )
    return content


def _check_is_whole(path: Path) -> bytes:
    """The first bytes of a file that is more than what git leaves where a large file belongs."""
    try:
        with regular(path).open("rb") as file:
            start = file.read(len(_PLACEHOLDER))
    except FileNotFoundError:
        raise CheckpointError(f"no {path}; download it, see gvtools weights list") from None
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror or error})") from None
    if not start:
        raise CheckpointError(f"{path}: is empty; download it again")
    if start == _PLACEHOLDER:
        raise CheckpointError(
            f"{path}: is Git LFS's placeholder of {path.stat().st_size} bytes, not the file "
            "itself; fetch that with git lfs pull"
        )
    return start


def _refused(error: Exception) -> str:
    """What a pickle asks for that is not loaded."""
    asked = re.search(r"GLOBAL ([\w.]+)|WeightsUnpickler error: ([^\n]+)", str(error))
    if asked is None:
        return f"is refused ({first_line(error)}); expected tensors and plain values alone"
    if asked[1]:
        return f"asks for {asked[1]}; expected tensors and plain values alone, without code"
    return f"cannot be read ({asked[2].strip()}); expected a whole file of tensors alone"


def first_line(error: Exception) -> str:
    """An error's first line, at most one sentence of it."""
    text = str(error).strip().splitlines()
    return text[0].split(". ")[0] if text else type(error).__name__
