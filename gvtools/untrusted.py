"""Files that others made, read without trust: no wait, no code, no more memory than they deserve.

What is wrong with a file ends in OSError or ValueError here, which every reader turns into its own
error with the file's name. A file may be a pipe, a device or a folder; JSON may be nested a
thousandfold; an archive or an array may claim terabytes in a kilobyte; a name may lead anywhere.
"""

from __future__ import annotations

import atexit
import codecs
import csv
import gzip
import hashlib
import io
import json
import math
import os
import shutil
import stat
import struct
import sys
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

from gvtools.errors import ProjectError

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from PIL import Image

# What may be unpacked of a compressed file: so many bytes, and so many for each of its own.
UNPACKED_BYTES, UNPACKED_RATIO = 192 << 20, 2
# What pixels of a picture may take: a blank picture is packed tightly, but not without end.
PIXEL_BYTES, PIXEL_RATIO = 80 << 20, 200
# Integers of more digits are larger than any float.
MOST_INTEGER = 300
# Of a YAML text, whose parser needs seconds for a megabyte, and with its aliases written out.
MOST_CHARACTERS, MOST_NODES = 400_000, 100_000
# Numbers of more digits than this are none.
MOST_DIGITS = 400
# What parsers stumble upon in damaged files, they raise as it comes.
PARSER_ERRORS = (
    TypeError, AttributeError, ArithmeticError, SyntaxError, EOFError, RuntimeError, MemoryError,
    struct.error, zlib.error, csv.Error,
)  # fmt: skip
DAMAGED = (OSError, ValueError, LookupError, StopIteration, *PARSER_ERRORS)


# What files named as pictures begin with when they are none that is read.
HELD = {
    **dict.fromkeys((b"ftyphei", b"ftyphev", b"ftypmif1", b"ftypmsf1"), "HEIC: convert it to JPEG"),
    b"ftypavi": "AVIF: convert it to JPEG",
    b"jxl ": "JPEG XL: convert it to PNG",
    b"git-lfs": "a pointer of Git LFS: fetch the file by 'git lfs pull'",
    b"%pdf": "PDF",
    b"<!doctype": "a web page: download it again",
    b"<html": "a web page: download it again",
    b"ftyp": "a video",
    b"pk\x03\x04": "a ZIP archive: unpack it",
}


@contextmanager
def reading(
    where: Path | str,
    advice: str = "expected a complete file; copy or export it again",
    *,
    also: tuple[type[Exception], ...] = (),
) -> Iterator[None]:
    """Refuses the file that is read inside, whatever its damage makes a parser raise."""
    stumbles: tuple[type[Exception], ...] = (*DAMAGED, *also)
    try:
        yield
    except stumbles as error:
        raise ProjectError(f"{where}: {_reason(error, str(where))}; {advice}") from None


def expect(holds: object, found: str) -> None:
    """Within ``reading``: what does not hold makes the content unreadable, in these words."""
    if not holds:
        raise ValueError(found)


def _reason(error: Exception, where: str) -> str:
    if isinstance(error, FileNotFoundError):
        return "no such file"
    text = str(getattr(error, "strerror", None) or error)
    if type(error).__name__ == "UnidentifiedImageError":
        text = "no picture"
    elif type(error).__name__ == "ValidationError":
        first = error.errors()[0]  # type: ignore[attr-defined]
        text = f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}"
    elif isinstance(error, KeyError) and error.args:
        text = str(error.args[0])
        text = text if " " in text else f"no {text!r}"
    lines = text.replace(repr(where), "").replace(where, "").strip(" :\n").splitlines() or [
        type(error).__name__
    ]
    return f"unreadable ({lines[0]})"


def regular(path: Path) -> Path:
    """``path``, where it is a file: not a folder, a pipe or a device, of which reading has no end.

    >>> regular(Path("/"))
    Traceback (most recent call last):
        ...
    OSError: [Errno 22] is a folder; expected a file: '/'
    """
    try:
        mode = os.stat(path).st_mode
    except ValueError as error:  # a name with a null
        raise OSError(22, str(error), repr(str(path))) from None
    if not stat.S_ISREG(mode):
        what = "folder" if stat.S_ISDIR(mode) else "pipe or a device"
        raise OSError(22, f"is a {what}; expected a file", str(path))
    return path


def is_file(path: Path) -> bool:
    """Whether a file is there; False for names that no file can have, too long or with a null."""
    return os.path.isfile(path)


def read_bytes(path: Path) -> bytes:
    """What a file holds."""
    return regular(path).read_bytes()


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, as hex digits."""
    total = hashlib.sha256()
    with regular(path).open("rb") as file:
        while chunk := file.read(1 << 20):
            total.update(chunk)
    return total.hexdigest()


def read_text(path: Path, *, errors: str = "strict") -> str:
    """A text file, in UTF-8 or, with a byte order mark, UTF-16; no mark, lines end by LF."""
    data = read_bytes(path)
    marked = data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    text = data.decode("utf-16" if marked else "utf-8-sig", errors)
    return text.replace("\r\n", "\n").replace("\r", "\n")


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text.

    >>> parse_json("[" * 100_000)
    Traceback (most recent call last):
        ...
    ValueError: nested too deep for JSON
    """
    try:
        return json.loads(text, parse_int=_integer)
    except RecursionError:
        raise ValueError("nested too deep for JSON") from None


def _integer(digits: str) -> int:
    """An integer that is a number for NumPy, too, if not one of 64 bits."""
    if len(digits) > MOST_INTEGER:
        raise ValueError(f"an integer of {len(digits)} digits")
    return int(digits)


def read_json(path: Path) -> Any:
    """The value in a JSON file."""
    return parse_json(read_text(path))


def parse_yaml(text: str, *, most: int = MOST_CHARACTERS) -> Any:
    r"""The value of a YAML text: plain data, with no more values than a long text holds.

    >>> parse_yaml("a: &x [1, two]\nb: *x")
    {'a': [1, 'two'], 'b': [1, 'two']}
    >>> parse_yaml("a: &x [*x]")
    Traceback (most recent call last):
        ...
    ValueError: an alias of what holds it
    """
    import yaml

    if len(text) > most:
        raise ValueError(f"{len(text)} characters; expected at most {most}")
    try:
        value = yaml.safe_load(text)
        limit = max(MOST_NODES, most // 8)
        if _nodes(value, {}) > limit:
            raise ValueError(f"aliases stand for more than {limit} values")
        return value
    except (yaml.YAMLError, *PARSER_ERRORS, KeyError) as error:
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f"line {mark.line + 1}: "
        problem = getattr(error, "problem", None) or f"no YAML ({type(error).__name__})"
        raise ValueError(f"{where}{problem}") from None


def _nodes(value: Any, known: dict[int, int]) -> int:
    """How many values there are when every alias is written out."""
    if not isinstance(value, (dict, list)):
        return 1
    if id(value) in known:
        if known[id(value)] < 0:
            raise ValueError("an alias of what holds it")
        return known[id(value)]
    known[id(value)] = -1
    inner = [*value, *value.values()] if isinstance(value, dict) else value
    known[id(value)] = 1 + sum(_nodes(item, known) for item in inner)
    return known[id(value)]


def named_file(folder: Path, name: str | Path, *, where: str, follow_links: bool = False) -> Path:
    """The path of a file that another file names, which has to lie in a folder.

    The folder itself may be reached over links; from there on, neither "..", an absolute path nor
    a link may lead out of it. The file need not be there.

    ``where`` is the other file and the place in it. With ``follow_links``, links may lead out, as
    those of a download that is kept elsewhere; the name itself still may not.
    """
    try:
        # What begins with the folder already is not joined to it again.
        inside = isinstance(name, Path) and name.is_relative_to(folder)
        path = Path(name) if inside else folder / name
        resolved = os.path.abspath if follow_links else os.path.realpath
        home, real = resolved(folder), resolved(path)
        wrong = "a null in its name" if "\0" in real else ""
        if real != home and not real.startswith(home.rstrip("/") + "/"):
            wrong = f"which lies outside of {folder}"
    except (OSError, ValueError) as error:
        wrong = str(error)
    if wrong:
        raise ProjectError(
            f"{where}: names the file {str(name)[:80]!r}, {wrong}; expected a path below {folder}; "
            "copy the file there"
        )
    return path


@contextmanager
def archive(source: Path | bytes) -> Iterator[zipfile.ZipFile]:
    """A ZIP archive, open for reading, whose members together unpack to a sensible size."""
    try:
        size = len(source) if isinstance(source, bytes) else regular(source).stat().st_size
        with zipfile.ZipFile(io.BytesIO(source) if isinstance(source, bytes) else source) as opened:
            claimed = sum(item.file_size for item in opened.infolist())
            if claimed > UNPACKED_RATIO * size + UNPACKED_BYTES:
                raise ValueError(f"its members claim {claimed} bytes in a file of {size}")
            yield opened
    except (zipfile.BadZipFile, *PARSER_ERRORS) as error:
        raise ValueError(f"damaged archive: {error or type(error).__name__}") from None


def unpacked(path: Path, *, whole: bool = False) -> Path:
    """What an archive holds (ZIP, or tar by gzip), in a folder that lasts as long as the process.

    Folders that hold one folder alone are gone through, unless it is to be the ``whole``. Files
    have the archive's time, so that they are the same ones whenever it is unpacked.
    """
    with reading(path):
        time = regular(path).stat().st_mtime_ns
    home = _unpacked(path.resolve(), time)
    while not whole and len(inner := list(home.iterdir())) == 1 and inner[0].is_dir():
        home = inner[0]
    return home


@cache
def _unpacked(path: Path, time: int) -> Path:
    work = Path(tempfile.mkdtemp(prefix="gvtools-"))
    atexit.register(shutil.rmtree, work, ignore_errors=True)
    # Messages that name its files tell which archive is meant.
    home = work / path.name
    home.mkdir()
    advice = "expected an archive; copy or export it again, or unpack it and give its folder"
    with reading(path, advice, also=(tarfile.TarError, zipfile.BadZipFile)):
        for name, content in _files_of(path):
            if not name.startswith("__MACOSX/"):
                file = named_file(home, name.replace("\\", "/"), where=str(path))
                file.parent.mkdir(parents=True, exist_ok=True)
                with file.open("wb") as target:
                    shutil.copyfileobj(content, target)
                os.utime(file, ns=(time, time))
    return home


def _files_of(path: Path) -> Iterator[tuple[str, IO[bytes]]]:
    """Name and content of each file in an archive."""
    if path.suffix.lower() in (".gz", ".tgz"):
        most = UNPACKED_RATIO * path.stat().st_size + UNPACKED_BYTES
        with gzip.open(path) as packed:
            # As a stream, of which nothing is skipped unread.
            stream: Any = LimitedReader(packed, most)
            with tarfile.open(fileobj=stream, mode="r|") as tar:
                for member in filter(tarfile.TarInfo.isfile, tar):  # links may lead anywhere
                    yield member.name, cast("IO[bytes]", tar.extractfile(member))
        return
    with archive(path) as opened:
        for item in opened.infolist():
            if not item.filename.endswith(("/", "\\")):
                with opened.open(item) as content:
                    yield item.filename, content


def other_version(found: object, known: int, advice: str) -> str:
    """What to do about a file of another version than the known one, older or newer.

    >>> other_version(5, 4, "run it again")
    'it is newer than this program: update gvtools, or save it in version 4'
    """
    if isinstance(found, int) and found > known:
        return f"it is newer than this program: update gvtools, or save it in version {known}"
    return advice


class LimitedReader:
    """A stream of which no more than so many bytes can be read."""

    def __init__(self, stream: gzip.GzipFile, most: int) -> None:
        self.stream, self.left = stream, most

    def read(self, size: int) -> bytes:
        """Read on."""
        found = self.stream.read(size)
        self.left -= len(found)
        if self.left < 0:
            raise ValueError("more than such a file can hold")
        return found


def load_arrays(source: Path | bytes, *names: str) -> dict[str, NDArray[Any]]:
    """Arrays of an ``.npz`` file by name, or all of them, without pickle."""
    with archive(source) as opened:
        held = {item.removesuffix(".npy") for item in opened.namelist()}
        for name in names:
            if name not in held:
                raise KeyError(f"no array {name!r} among {', '.join(sorted(held)[:8])}")
        return {name: _member(opened, name) for name in (names or sorted(held))}


def _member(opened: zipfile.ZipFile, name: str) -> NDArray[Any]:
    whole = f"{name}.npy" if f"{name}.npy" in opened.namelist() else name
    with opened.open(whole) as stream:
        return read_array(stream, opened.getinfo(whole).file_size)


def load_array(path: Path) -> NDArray[Any]:
    """The array of an ``.npy`` file, without pickle."""
    with regular(path).open("rb") as stream:
        return read_array(stream, path.stat().st_size)


def read_array(stream: IO[bytes], size: int) -> NDArray[Any]:
    """The array that a stream of ``size`` bytes holds in NumPy's format.

    NumPy itself takes memory for whatever shape the head names before it reads.
    """
    import numpy as np

    form: Any = np.lib.format
    try:
        version = form.read_magic(stream)
        heads = {(1, 0): form.read_array_header_1_0, (2, 0): form.read_array_header_2_0}
        shape, _, dtype = heads[version](stream)
    except Exception as error:
        # What its parser of the head, which is Python's own, stumbles upon, it raises as it comes.
        raise ValueError(f"an array with a damaged head ({type(error).__name__})") from None
    fits = min(shape, default=0) >= 0 and math.prod(map(int, shape)) * dtype.itemsize <= size
    if dtype.hasobject or not fits:  # objects may hold code
        raise ValueError(f"an array of shape {shape} and type {dtype} in {size} bytes")
    stream.seek(0)
    array: NDArray[Any] = form.read_array(stream, allow_pickle=False)
    if dtype.kind == "U" and array.size:
        signs = np.ascontiguousarray(array).reshape(-1).view(f"{dtype.byteorder}u4")
        if (signs > sys.maxunicode).any():
            raise ValueError("an array of texts whose signs are none")
    return array


def _held(source: Path | bytes) -> str:
    """What the first bytes of a file say that is no picture, "" where they say nothing."""
    with io.BytesIO(source) if isinstance(source, bytes) else source.open("rb") as file:
        head = file.read(32).lower()
    return next((kind for mark, kind in HELD.items() if mark in head), "")


def open_picture(source: Path | bytes) -> Image.Image:
    """A picture, open but not decoded, whose pixels take no more memory than its file explains."""
    from PIL import Image, UnidentifiedImageError

    size = len(source) if isinstance(source, bytes) else regular(source).stat().st_size
    try:
        image = Image.open(io.BytesIO(source) if isinstance(source, bytes) else source)
    except (Image.DecompressionBombError, LookupError, OSError, *PARSER_ERRORS) as error:
        text = str(error) or type(error).__name__
        if isinstance(error, UnidentifiedImageError):
            kind = _held(source)
            text = f"no picture{kind and f', but {kind}'}"
        raise ValueError(text) from None
    width, height = image.size
    pixel = len(image.getbands()) * (4 if image.mode[:1] in "IF" else 1)
    if width * height * pixel > PIXEL_BYTES + PIXEL_RATIO * size:
        image.close()
        raise ValueError(f"{width}x{height} pixels in {size} bytes")
    return image


def number_key(digits: str) -> int:
    """Digits as a number to sort by, however many they are.

    >>> number_key("010"), number_key("9" * 10_000) == number_key("8" * 9_000)
    (10, True)
    """
    return int(digits) if len(digits) <= MOST_DIGITS else 10**MOST_DIGITS
