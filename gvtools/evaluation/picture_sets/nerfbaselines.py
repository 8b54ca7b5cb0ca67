"""NerfBaselines' predictions: a folder or ``predictions-STEP.tar.gz`` with color/ and gt-color/.

Both hold ``info.json``, ``color/NAME.png`` and ``gt-color/NAME.png``, NAME being the photograph's
path below the data set's image folder, and more that is not read here: cameras, masks, depth
(nerfbaselines/io.py, _save_predictions_iterate). Transparent pixels lie before black, as in its own
evaluation. Its depth is not read: the files do not say whether it is along the ray.
"""

from __future__ import annotations

import gzip
import io
import re
import tarfile
import zlib
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.evaluation.picture_matching import IMAGE_ENDINGS
from gvtools.evaluation.picture_sets.pictures import Picture, PictureSet, image_files, read_rgb
from gvtools.scenes.scene import Frame, natural_key
from gvtools.untrusted import UNPACKED_BYTES, UNPACKED_RATIO, LimitedReader, regular

COLOR, TRUTH = "color/", "gt-color/"
LAYOUT = "NerfBaselines"
_ARCHIVE = re.compile(r"predictions-(\d+)\.tar\.gz")


def predictions(path: Path) -> PictureSet | None:
    """The pictures of a folder or archive of predictions; None where it is none.

    Args:
        path: the folder, the archive, or the folder of a training with its archives.
    """
    if path.name.endswith(".tar.gz"):
        return _archive(path, path)
    if (path / "info.json").is_file() and (path / COLOR).is_dir():
        files = image_files(path / COLOR)
        return PictureSet(path, LAYOUT, tuple(_picture(file, path) for file in files))
    archives = {int(m[1]): file for file in path.iterdir() if (m := _ARCHIVE.fullmatch(file.name))}
    if not archives:
        return None
    last = max(archives)
    return _archive(archives[last], path, others=len(archives) - 1)


def _picture(file: Path, folder: Path) -> Picture:
    name = file.relative_to(folder / COLOR)
    truth = folder / TRUTH / name
    return Picture(
        name.as_posix(),
        lambda: Frame(read_rgb(file)),
        partial(read_rgb, truth) if truth.is_file() else None,
    )


def _archive(file: Path, path: Path, *, others: int = 0) -> PictureSet:
    stored: dict[str, bytes] = {}
    try:
        most = UNPACKED_RATIO * regular(file).stat().st_size + UNPACKED_BYTES
        with gzip.open(file) as packed, _tar(LimitedReader(packed, most)) as tar:
            for member in tar:
                name = member.name.removeprefix("./")
                picture = Path(name).suffix.lower() in IMAGE_ENDINGS
                if member.isfile() and picture and name.startswith((COLOR, TRUTH)):
                    content = tar.extractfile(member)
                    stored[name] = content.read() if content else b""
    except (OSError, EOFError, ValueError, zlib.error, tarfile.TarError) as error:
        raise ProjectError(
            f"{file}: no readable archive ({error}); expected predictions of NerfBaselines"
        ) from None
    names = sorted((name for name in stored if name.startswith(COLOR)), key=natural_key)
    if not names:
        raise ProjectError(
            f"{file}: no pictures under {COLOR}; expected predictions of NerfBaselines"
        )
    notes = (f"{file.name} taken, the last of {others + 1}",) if others else ()
    return PictureSet(
        path, LAYOUT, tuple(_stored(name, stored, file) for name in names), notes=notes
    )


def _tar(stream: LimitedReader) -> tarfile.TarFile:
    # As a stream, of which nothing is skipped unread.
    return tarfile.open(fileobj=stream, mode="r|")  # type: ignore[call-overload, no-any-return]


def _stored(name: str, stored: dict[str, bytes], file: Path) -> Picture:
    short = name.removeprefix(COLOR)

    def read(key: str) -> NDArray[np.uint8]:
        return read_rgb(io.BytesIO(stored[key]), name=f"{file}: {key}")

    return Picture(
        short,
        lambda: Frame(read(name)),
        partial(read, TRUTH + short) if TRUTH + short in stored else None,
    )
