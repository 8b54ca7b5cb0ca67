"""Published weights: their files, as far as these are known, and how they come into a folder.

Revisions, sizes and SHA-256 are those of the publishers' pages, as seen in November 2026; of some
files the first digits of the hash alone are known, of others nothing.
"""

from __future__ import annotations

import http.client
import re
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple
from urllib.parse import quote

from gvtools.errors import CheckpointError, OptionError, ProjectError
from gvtools.files import check_space, flush_file, make_folder
from gvtools.untrusted import sha256_of

HUB = "https://huggingface.co/{repo}/resolve/{revision}/{path}"
GIT = "https://raw.githubusercontent.com/{repo}/{revision}/{path}"
_CHUNK = 1 << 20
_ABOUT = 0.05  # a rounded size is right within this share
# Attempts that bring nothing, one after another, and seconds before they are repeated.
ATTEMPTS, WAIT, TIMEOUT = 5, 1.0, 60.0
# A server's answers that another attempt may mend.
_PASSING = (408, 416, 429, 500, 502, 503, 504)


@dataclass(frozen=True)
class Published:
    """A file, and what is known of it."""

    place: str  # below the folder that it is fetched into
    repo: str
    path: str  # within ``repo``
    size: int  # bytes
    sha256: str = ""  # or its first digits; empty where it is not known
    revision: str = "main"  # a commit, where one is known
    about: bool = False  # whether ``size`` is rounded
    host: str = HUB
    optional: bool = False
    older: Mapping[str, str] = field(default_factory=dict)  # first digits of a hash: what it is

    def address(self, source: str) -> str:
        """At its publisher's, or at a mirror or in a folder laid out as the one it goes into."""
        template = source or self.host
        if "://" not in template:
            return str(Path(template) / self.place)
        if not re.match("https?://[^/]", template):
            raise OptionError(f"--from {source}; expected https://, http:// or a folder")
        if "{" not in template:
            return f"{template.rstrip('/')}/{quote(self.place)}"
        try:
            return template.format(repo=self.repo, revision=self.revision, path=quote(self.path))
        except (LookupError, ValueError, AttributeError):
            raise OptionError(
                f"--from {source!r}; expected an address, in which {{repo}}, {{revision}} and "
                "{path} may stand, or a folder"
            ) from None

    def fits(self, size: int) -> bool:
        """Whether a file has as many bytes, as far as these are known."""
        return abs(size - self.size) <= (_ABOUT * self.size if self.about else 0)

    def sizes(self, found: int) -> str:
        """The bytes that were found, and those that were expected."""
        return f"{found:,} bytes; expected {'about ' if self.about else ''}{self.size:,}"

    def difference(self, path: Path) -> str:
        """What a whole file is that is not the published one; empty if it is, as far as known."""
        size = path.stat().st_size
        if not self.fits(size):
            return self.sizes(size)
        found = sha256_of(path) if self.sha256 else ""
        if found.startswith(self.sha256):
            return ""
        for start, what in self.older.items():
            if found.startswith(start):
                return f"an older revision ({what})"
        return f"of sha256 {found[:16]}...; expected {self.sha256[:16]}..."

    def unknown(self) -> str:
        """What is not known of the file, in words."""
        parts = ["its revision"] if self.revision == "main" else []
        parts += ["its exact size"] if self.about else []
        parts += ["its sha256"] if not self.sha256 else []
        parts += ["more than the first digits of its sha256"] if 0 < len(self.sha256) < 64 else []
        return ", ".join(parts)


# DA3 by name: bytes, sha256 and revision of its model.safetensors.
_DEPTH = {
    "SMALL": (
        137_248_940, "364492e38a3a06d221ac75da7f6621ada3f2361cd24fde11ba79091e9f40efcf",
        "e08cab65ca0ec38e7826075418411ab90cab4da3",
    ),
    "BASE": (
        541_518_028, "e01067dc1659613083d9145a9a2547ccdbe6ccbbf83c4fe7b3e8a4e2bdae78b5",
        "f4a6c9b3c95e41c82048423d3493a81ec3fa810e",
    ),
    "LARGE-1.1": (
        1_643_843_860, "739905c423cf0d6ccaf9e61a8401d82ba1ac32d7f4d3ee6dca8f92b377633f64",
        "0e109ae307c5982f319a67cf6f9f99ccdc0ec97c",
    ),
}  # fmt: skip


def _depth(name: str, folder: str = "") -> Published:
    repo, path = f"depth-anything/DA3-{name}", "model.safetensors"
    size, sha256, revision = _DEPTH[name]
    return Published(f"{folder}{path}", repo, path, size, sha256, revision=revision)


def _gld(path: str, size: int, sha256: str, **more: Any) -> Published:
    return Published(path, "SeonghuJeon/GLD", path, size, sha256, **more)


def _statistics(level: int, sha256: str) -> Published:
    path = f"model_stats/da3/normalization_stats_level{level}.pt"
    repo, revision = (
        "cvlab-kaist/Geometric-Latent-Diffusion",
        "574b283de29f686d27068493e799a9fe728a1e35",
    )
    return Published(path, repo, path, 20_900, sha256, revision=revision, host=GIT, about=True)


def _vace(path: str, size: int, sha256: str = "") -> Published:
    return Published(path, "alibaba-pai/Wan2.2-VACE-Fun-A14B", path, size, sha256)


_OLDER = {"b6526141": "replaced on March 25th, 2026, because of another camera convention"}
MODELS: dict[str, tuple[Published, ...]] = {
    "gld": (
        _depth("BASE", "pretrained_models/da3/"),
        _gld("checkpoints/da3_level1.pt", 3_130_000_000, "557e99e5", about=True, older=_OLDER),
        _gld("checkpoints/da3_cascade.pt", 1_890_000_000, "ecf5d36c", about=True),
        _gld("pretrained_models/mae_decoder.pt", 1_690_296_850, "0edc8daf"),
        _statistics(0, "84be3bfb"),
        _statistics(1, "b158eae3"),
        _gld(
            "pretrained_models/da3/dpt_decoder.pt", 470_000_000, "a25e5c57", about=True,
            optional=True,
        ),
    ),
    "da3-small": (_depth("SMALL"),),
    "da3-base": (_depth("BASE"),),
    "da3-large": (_depth("LARGE-1.1"),),
    "wan-vace": (
        _vace("low_noise_model/diffusion_pytorch_model.safetensors", 34_675_325_000),
        _vace(
            "Wan2.1_VAE.pth", 507_609_880,
            "38071ab59bd94681c686fa51d75a1968f64e470262043be31f7a094e442fd981",
        ),
        _vace(
            "models_t5_umt5-xxl-enc-bf16.pth", 11_361_920_418,
            "7cace0da2b446bbbbc57d031ab6cf163a3d59b366da94e5afe36745b746fd81d",
        ),
    ),
}  # fmt: skip
LICENCES = {
    "gld": "Apache-2.0 (model card); statistics MIT",
    "da3-large": "CC BY-NC 4.0, not for commercial use",
    "wan-vace": "Apache-2.0 (repository; check the model card)",
}
# What is done with a fetched folder; DIR is it.
NEXT = {
    "": ("gvtools reconstruct PROJECT --depth da3 --set da3.weights=DIR --out RUN",),
    "gld": ("gvtools weights check DIR",),
    "wan-vace": (
        "gvtools weights truncate-wan DIR GLD/video, GLD being the folder of gld",
        "gvtools weights empty-prompt DIR GLD/video",
    ),
}


def fetch(
    files: Sequence[Published],
    to: Path,
    *,
    source: str = "",  # a folder or an address that has them, instead of their publishers
    say: Callable[[str], None] = lambda line: None,
    progress: Callable[[int, int], None] = lambda done, total: None,  # bytes
) -> None:
    """Bring files into a folder, each under its name when it is whole and what it should be.

    What an interrupted attempt has left is continued.
    """
    absent = []
    for file in files:
        file.address(source)  # refused before anything is made
        target = to / file.place
        if not target.exists():
            absent.append(file)
        elif wrong := file.difference(target):
            raise CheckpointError(f"{target}: is there, and is {wrong}; remove it and fetch again")
        else:
            say(f"{file.place}: is there already")
    make_folder(to)
    total = sum(file.size for file in absent)
    check_space(to, total - sum(min(_size(_part(to, f)), f.size) for f in absent))
    done = 0
    for file in absent:
        part, address = _part(to, file), file.address(source)
        make_folder(part.parent)

        def report(count: int, before: int = done) -> None:
            progress(before + count, total)

        _bring(file, part, address, progress=report)
        if wrong := file.difference(part):
            _forget(part)
            raise CheckpointError(
                f"{address}: is {wrong}; it was not kept; fetch again, or from another source "
                "(--from)"
            )
        flush_file(part)
        part.replace(to / file.place)
        _forget(part)
        done += file.size
        found = "" if file.sha256 else f", sha256 {sha256_of(to / file.place)}"
        unknown = file.unknown()
        say(f"{file.place}: fetched{found}{f'; not known: {unknown}' if unknown else ''}")


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _part(to: Path, file: Published) -> Path:
    target = to / file.place
    return target.with_name(f".{target.name}.part")


def _version(part: Path) -> Path:
    """Holds what the server calls the version that a part is of."""
    return part.with_name(f"{part.name}.etag")


def _forget(part: Path) -> None:
    part.unlink(missing_ok=True)
    _version(part).unlink(missing_ok=True)


def _bring(file: Published, part: Path, address: str, *, progress: Callable[[int], None]) -> None:
    """Download until the part is whole; attempts that bring nothing are counted."""
    failed = 0
    while True:
        before = _size(part)
        try:
            _attempt(file, part, address, progress=progress)
            return
        except (OSError, http.client.HTTPException) as error:
            failed = 0 if _size(part) > before else failed + 1
            code = error.code if isinstance(error, urllib.error.HTTPError) else 0
            lasting = code != 0 and code not in _PASSING
            if code == 416:  # the part is whole already, or more than that
                if file.sha256 and not file.difference(part):
                    return
                _forget(part)
            if failed >= ATTEMPTS or lasting:
                raise CheckpointError(
                    f"{address}: {error or type(error).__name__}; {_size(part):,} of "
                    f"{file.size:,} bytes are kept; fetch again to continue, or from another "
                    "source (--from)"
                ) from None
            time.sleep(WAIT * 2**failed)


def _attempt(file: Published, part: Path, address: str, *, progress: Callable[[int], None]) -> None:
    """One connection; what it brings is appended to the part."""
    have, version = _size(part), ""
    if _version(part).exists():
        version = _version(part).read_text(encoding="utf-8")
    # Without a hash or a version nothing would tell that the rest is of the same file.
    if not (file.sha256 or version) or (have > file.size and not file.fits(have)):
        have = 0
    if have == file.size and not file.about:
        return
    with _opened(address, have, version) as answer:
        if not file.fits(answer.total):
            raise CheckpointError(
                f"{address}: has {file.sizes(answer.total)}; another revision, or another file"
            )
        _version(part).write_text(answer.version, encoding="utf-8")
        with part.open("r+b" if answer.start else "wb") as out:
            out.truncate(answer.start)
            out.seek(answer.start)
            while out.tell() < answer.total:
                chunk = answer.stream.read(min(_CHUNK, answer.total - out.tell()))
                if not chunk:
                    raise ConnectionError("the connection ended too early")
                try:
                    out.write(chunk)
                except OSError as error:
                    raise ProjectError(
                        f"{part}: cannot be written ({error.strerror or error}); free some space, "
                        "and fetch again to continue"
                    ) from None
                progress(out.tell())


class _Answer(NamedTuple):
    """An open file, from ``start`` on, of ``total`` bytes."""

    stream: IO[bytes] | http.client.HTTPResponse
    start: int
    total: int
    version: str = ""  # of the file, as its server calls it


@contextmanager
def _opened(address: str, have: int, version: str) -> Iterator[_Answer]:
    """A file of a folder or of a server, after the bytes that are there already if it can be."""
    if "://" not in address:
        path = Path(address)
        if not path.is_file():
            raise CheckpointError(
                f"no {address}; expected the folder to be laid out as a fetched one"
            )
        with path.open("rb") as file:
            file.seek(have)
            yield _Answer(file, have, path.stat().st_size)
        return
    asked = {"Accept-Encoding": "identity", "User-Agent": "gvtools"}
    if have:
        asked["Range"] = f"bytes={have}-"
        asked |= {"If-Range": version} if version else {}
    request = urllib.request.Request(address, headers=asked)
    with closing(urllib.request.urlopen(request, timeout=TIMEOUT)) as answer:
        span = re.fullmatch(r"bytes (\d+)-\d+/(\d+)", answer.headers.get("Content-Range", ""))
        length = answer.headers.get("Content-Length", "")
        if answer.status == 206 and span and int(span[1]) == have:
            total = int(span[2])
        elif answer.status == 200 and length.isdecimal():
            have, total = 0, int(length)
        else:
            raise CheckpointError(
                f"{address}: status {answer.status} without the bytes that were asked for, or "
                "their number; fetch from another source (--from)"
            )
        tag = answer.headers.get("ETag", "")
        yield _Answer(answer, have, total, "" if tag.startswith("W/") else tag)
