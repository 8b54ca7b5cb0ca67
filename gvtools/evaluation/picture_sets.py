"""Pictures that any method made: read from the folders that its tools write, matched with views.

nerfstudio: ``ns-render dataset`` writes ``OUT/SPLIT/OUTPUT/NAME`` for the outputs rgb, gt-rgb and
more, NAME being the photograph's path below the folder that all photographs have in common
(nerfstudio/scripts/render.py, DatasetRender). ``ns-eval --render-output-path`` writes
``NNNNNN-img.jpg``, the truth on the left and the render on the right
(VanillaPipeline.get_average_image_metrics). NNNNNN counts the views of the split as the data set
has them: nerfstudio's own format in alphabetical order of the photographs' paths, which is taken
here, COLMAP's in the order of the images' numbers. The truths beside the renders tell where it
differs. Pictures of ``ns-render`` along a path (``00000.jpg``) are a plain folder.

gsplat: ``RESULT/renders/val_stepSTEP_NNNN.png`` of its example trainers, truth and render side by
side, colours cut to 8 bits. NNNN counts the validation views in alphabetical order of their names
(examples/simple_trainer.py, Runner.eval). Of several steps the last one is taken.

3DGS and its descendants: ``RESULT/SPLIT/ours_STEP/renders/NNNNN.png`` and ``gt`` beside. NNNNN
counts the split's views in alphabetical order of their names (render.py, scene/dataset_readers.py).

NerfBaselines: a folder or ``predictions-STEP.tar.gz`` with ``info.json``, ``color/NAME.png`` and
``gt-color/NAME.png``, NAME being the photograph's path below the data set's image folder
(nerfbaselines/io.py, _save_predictions_iterate). Transparent pixels lie before black, as in its own
evaluation. Its depth is not read: the files do not say whether it is along the ray.

Names are compared in lower case, without the file extension, without folders where that finds more
partners, and without a prefix or suffix that most pictures share (``generated_NAME.png``,
``NAME.rgb.png``) or that all views do. By order, both are sorted naturally by name (2 before 10).
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.images import (
    IMAGE_SUFFIXES,
    UNREADABLE,
    read_depth,
    read_header,
    read_image,
)
from gvtools.scenes.scene import Frame, natural_key
from gvtools.untrusted import open_picture, reading, unpacked

SPLITS = ("test", "val", "train")
_CANVAS = re.compile(r"(\d{6})-img\.(jpg|png)", re.IGNORECASE)
_RENDER = re.compile(r"(val|compress)_step(\d+)_(\d{4,})\.png")
COLOR, TRUTH = "color/", "gt-color/"
LAYOUT = "NerfBaselines"
_ARCHIVE = re.compile(r"predictions-(\d+)\.tar\.gz")
RENDERED = ".rgb.png"


@dataclass(frozen=True)
class Matching:
    """Pictures and the views that they stand for."""

    rule: str  # "name" or "order"
    # For each view the index of its picture; None where there is none.
    picture_of: tuple[int | None, ...]
    missing: tuple[str, ...]  # names of the views without a picture
    left_over: tuple[str, ...]  # names of the pictures that stand for none of the views


def match_pictures(
    pictures: Sequence[str],
    views: Sequence[str],
    *,
    others: Sequence[str] = (),
    rule: str = "auto",
    alphabetical: bool = False,
    what: str = "pictures",
) -> Matching:
    """Match pictures with views.

    Args:
        views: names of the views that are to be judged.
        others: of the project's other views; pictures named like those stand for none by order.
        rule: "name", "order", or "auto": by name where any name matches, by order where none does
            and there are as many pictures as views.
        alphabetical: whether numbers in the pictures' names count the views in alphabetical order
            (img10 before img2); "auto" is "order" then.
        what: the pictures, as error messages call them.

    >>> match_pictures(["r_2.png", "r_10.png"], ["2.jpg", "10.jpg"])
    Matching(rule='name', picture_of=(0, 1), missing=(), left_over=())
    >>> match_pictures(["00001.png", "00000.png"], ["a.jpg", "b.jpg"]).picture_of
    (1, 0)
    """
    if not pictures:
        raise OptionError(f"{what}: no picture; expected one for each of {len(views)} views")
    # Pictures that are numbered alphabetically must not be taken for views whose names are numbers.
    by_name = rule == "name" or (rule == "auto" and not alphabetical)
    partners: list[int | None] = [None] * len(views)
    like: list[int] = []
    if by_name:
        partners, like = _by_name(pictures, views, what, others=others)
    found = sum(number is not None for number in partners)
    of, such, problem = f"of {len(pictures)} pictures", f"(such as {views[0]!r})", ""
    if rule == "auto" and like and not found:
        problem = (
            f"{len(like)} {of} (such as {pictures[like[0]]!r}) are named like views that are not "
            f"judged, and none like one that is {such}; give those views' pictures, or, where "
            "names count, --match order"
        )
    elif rule == "name" and not found:
        problem = (
            f"none {of} (first {pictures[0]!r}) is named like one of {len(views)} views {such}; "
            "rename them, or give --match order"
        )
    elif rule == "auto" and 0 < found < len(pictures) == len(views):
        problem = (
            f"{found} {of} are named like views, the others are not, and the order would give "
            "other partners; say --match name or --match order"
        )
    elif rule == "auto" and by_name and not found and _first_number(pictures) is None:
        problem = (
            f"the pictures' numbers (such as {pictures[0]!r}) are none of the views' {such} and "
            "do not count on by 1; name them like the views, or, for the order, give --match order"
        )
    elif not found and len(pictures) != len(views):
        problem = (
            f"{len(pictures)} pictures (first {pictures[0]!r}) for {len(views)} views {such}; "
            "expected names like the views', or as many pictures as views"
        )
    if problem:
        raise OptionError(f"{what}: {problem}")
    if not found:
        in_order = sorted(range(len(views)), key=views.__getitem__) if alphabetical else None
        in_order = in_order or _natural_order(views)
        for view, picture in zip(in_order, _natural_order(pictures), strict=True):
            partners[view] = picture
    used = set(partners)
    return Matching(
        "name" if found else "order",
        tuple(partners),
        tuple(view for view, number in zip(views, partners, strict=True) if number is None),
        tuple(name for number, name in enumerate(pictures) if number not in used),
    )


def _natural_order(names: Sequence[str]) -> list[int]:
    return sorted(range(len(names)), key=lambda number: natural_key(names[number]))


def _by_name(
    pictures: Sequence[str], views: Sequence[str], what: str, *, others: Sequence[str]
) -> tuple[list[int | None], list[int]]:
    """For each view the index of the picture with its name, or None; those of other views.

    Names with and without folders, and without what all views share: what finds most partners is
    taken, among all views where any is found, else among those to be judged. Zeros in front of
    numbers do not count, unless the pictures' numbers may merely count them, from 0 or 1.
    """
    every, best = (*views, *others), list[list[int]]()
    forms = (True,) if _first_number(pictures) in (0, 1) else (True, False)
    for judged, padded in product((len(every), len(views)), forms):
        best = [[] for _ in every[:judged]]
        for view_folders in (True, False):
            whole = [_key(name, folders=view_folders, padded=padded) for name in every]
            for view_keys in (whole[:judged], _without_affixes(whole)[:judged]):
                if len(set(view_keys)) == len(view_keys):
                    for folders in (True, False):
                        keys = [_key(name, folders=folders, padded=padded) for name in pictures]
                        best = max(
                            best, _partners(keys, view_keys), key=lambda p: sum(map(bool, p))
                        )
        if any(best):
            break
    like = [numbers[0] for numbers in best[len(views) :] if numbers]
    best = best[: len(views)]
    for view, numbers in zip(views, best, strict=True):
        if len(numbers) > 1:
            listed = ", ".join(repr(pictures[number]) for number in numbers[:2])
            raise OptionError(
                f"{what}: {len(numbers)} pictures of the view {view!r} ({listed}); expected one; "
                "give a folder with one picture a view"
            )
    return [numbers[0] if numbers else None for numbers in best], like


def _first_number(names: Sequence[str]) -> int | None:
    """From where names count that are numbers; None where they do not; -1 of others.

    >>> [_first_number([f"r_{n}.png" for n in pair]) for pair in ("23", "48", "ab")]
    [2, None, -1]
    """
    numbers = _without_affixes([_key(name, folders=False) for name in names])
    if not all(re.fullmatch(r"\d[\d._-]*", number) for number in numbers):
        return -1
    if not all(map(str.isdecimal, numbers)):
        return None
    found = sorted(map(int, numbers))
    return found[0] if found == list(range(found[0], found[0] + len(found))) else None


def _without_affixes(names: Sequence[str]) -> list[str]:
    """Names without the words that all of them begin or end with.

    >>> _without_affixes(["a-001.color", "a-012.color"])
    ['001', '012']
    """
    cuts = []
    for texts in (names, [name[::-1] for name in names]):
        low, high = min(texts), max(texts)
        shared = low[: next((i for i, sign in enumerate(low) if high[i] != sign), len(low))]
        words = re.sub("[0-9]+$", "", shared)
        if not all(text[len(words) : len(words) + 1].isdecimal() for text in texts):
            words = re.sub("[a-z0-9]+$", "", shared)
        if re.fullmatch(r"\d+\.", words):  # of numbers with the same decimals
            words = ""
        cuts.append(len(words))
    return [name[cuts[0] : len(name) - cuts[1]] or name for name in names]


def _partners(pictures: Sequence[str], views: Sequence[str]) -> list[list[int]]:
    """For each view the indices of the pictures that have its name between a prefix and a suffix.

    Prefix and suffix are those that most pictures have, none if possible. No view has a picture
    where several pairs of them are equally frequent.
    """
    index = {view: number for number, view in enumerate(views)}
    # Any view's name as a whole word, the longest first.
    names = "|".join(re.escape(view) for view in sorted(views, key=len, reverse=True))
    pattern = re.compile(rf"(?=(?<![a-z0-9])({names})(?![a-z0-9]))")
    affixes = Counter[tuple[str, str]]()
    for picture in pictures:
        affixes.update(
            {(picture[: m.start(1)], picture[m.end(1) :]) for m in pattern.finditer(picture)}
        )
    out: list[list[int]] = [[] for _ in views]
    most = max(affixes.values(), default=0)
    commonest = [pair for pair, count in affixes.items() if count == most]
    if len(commonest) != 1 and ("", "") not in commonest:
        return out
    before, behind = ("", "") if ("", "") in commonest else commonest[0]
    for number, picture in enumerate(pictures):
        inner = picture[len(before) : len(picture) - len(behind)]
        if before + inner + behind == picture and inner in index:
            out[index[inner]].append(number)
    return out


def _key(name: str, *, folders: bool, padded: bool = True) -> str:
    """A name as it is compared; folders may be joined to it by other signs elsewhere."""
    path = PurePosixPath(name.replace("\\", "/"))
    path = path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path
    key = str(path if folders else path.name).replace("/", "_").lower()
    return key if padded else re.sub(r"(?<!\d)0+(?=\d)", "", key)


@dataclass(frozen=True, eq=False)
class MethodPicture:
    """One picture."""

    name: str  # by which it is matched: its path below the folder of the pictures
    # Reads its pixels, and its depth where the method left any; raises ProjectError.
    load: Callable[[], Frame]
    # (H, W, 3) uint8, what the method's tool took for the truth, by which the order is checked;
    # None where the tool keeps none.
    load_truth: Callable[[], NDArray[np.uint8]] | None = None


@dataclass(frozen=True, eq=False)
class PictureSet:
    """The pictures of one method."""

    path: Path  # what was given
    layout: str  # whose layout it has
    pictures: tuple[MethodPicture, ...]  # in natural order of their names
    # Whether numbers in the names count the views in alphabetical order instead of natural order.
    alphabetical: bool = False
    notes: tuple[str, ...] = ()  # what was chosen or left out on reading

    @property
    def names(self) -> tuple[str, ...]:
        """Of the pictures."""
        return tuple(picture.name for picture in self.pictures)


def image_files(folder: Path) -> list[Path]:
    """The pictures in a folder and below it, in natural order; hidden ones are left out."""
    found = [
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in IMAGE_SUFFIXES
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
        and path.is_file()
    ]
    return in_natural_order(found, folder)


def in_natural_order(paths: Iterable[Path], folder: Path) -> list[Path]:
    """Paths in the natural order of what they are called below the folder."""
    return sorted(paths, key=lambda path: natural_key(path.relative_to(folder).as_posix()))


def read_picture(source: Path) -> Frame:
    """What is transparent lies before black, and is no part of the mask; as stored, not turned."""
    if not read_header(source).has_alpha:
        return read_image(source)
    with reading(source, "expected PNG or JPEG", also=UNREADABLE), open_picture(source) as image:
        rgba: NDArray[Any] = np.asarray(image.convert("RGBA")).astype(np.float64)
    rgb = np.rint(rgba[..., :3] * (rgba[..., 3:] / 255)).astype(np.uint8)
    return Frame(rgb, mask=rgba[..., 3] == 255)


def canvas_picture(file: Path, folder: Path) -> MethodPicture:
    """A picture whose left half is the truth and whose right half is the render."""
    name = file.relative_to(folder).as_posix()
    return MethodPicture(name, lambda: Frame(_half(file, 1)), lambda: _half(file, 0))


def _half(file: Path, side: int) -> NDArray[np.uint8]:
    canvas = read_picture(file).rgb
    width = canvas.shape[1]
    if width % 2:
        raise ProjectError(
            f"{file}: {width} pixels wide; expected truth and render of one width side by side"
        )
    return np.ascontiguousarray(canvas[:, side * width // 2 :][:, : width // 2])


def _beside_truths(folder: Path, truths: Path) -> tuple[MethodPicture, ...]:
    """The pictures below ``folder``, whose truths lie at the same paths elsewhere."""

    def picture(file: Path) -> MethodPicture:
        name = file.relative_to(folder)
        truth = (lambda: read_picture(truths / name).rgb) if (truths / name).is_file() else None
        return MethodPicture(name.as_posix(), partial(read_picture, file), truth)

    return tuple(map(picture, image_files(folder)))


def nerfstudio_dataset(path: Path) -> PictureSet | None:
    """The pictures of ``ns-render dataset``, in the folder of all splits or of one; or None."""
    splits = {split: path / split for split in SPLITS if (path / split / "rgb").is_dir()}
    folder = next(iter(splits.values()), path)
    if not (folder / "rgb").is_dir():
        return None
    notes = []
    if len(splits) > 1:
        notes.append(f"split {folder.name} taken; also there: {', '.join(list(splits)[1:])}")
    pictures = _beside_truths(folder / "rgb", folder / "gt-rgb")
    return PictureSet(path, "nerfstudio, ns-render dataset", pictures, notes=tuple(notes))


def nerfstudio_evaluation(path: Path) -> PictureSet | None:
    """The pictures of ``ns-eval --render-output-path``; None where the folder is none."""
    canvases = [file for file in path.iterdir() if _CANVAS.fullmatch(file.name)]
    if not canvases:
        return None
    pictures = tuple(canvas_picture(file, path) for file in in_natural_order(canvases, path))
    notes = ("renders are the right halves of the pictures, which are JPEG",)
    return PictureSet(path, "nerfstudio, ns-eval", pictures, alphabetical=True, notes=notes)


def gsplat_renders(path: Path) -> PictureSet | None:
    """The validation pictures of a run's folder, or of its ``renders``; None without any."""
    folder = path / "renders" if (path / "renders").is_dir() else path
    found: dict[tuple[str, int], list[Path]] = defaultdict(list)
    for file in folder.iterdir():
        if match := _RENDER.fullmatch(file.name):
            found[match[1], int(match[2])].append(file)
    if not found:
        return None
    # What the trainer's last evaluation gave; pictures of the compressed model only by themselves.
    stage, step = max(found, key=lambda key: (key[0] == "val", key[1]))
    notes = ["renders are the right halves of the pictures"]
    if others := sorted(f"{name}_step{number}" for name, number in {*found} - {(stage, step)}):
        notes.append(f"{stage}_step{step} taken; also there: {', '.join(others)}")
    files = in_natural_order(found[stage, step], folder)
    pictures = tuple(canvas_picture(file, folder) for file in files)
    return PictureSet(path, "gsplat", pictures, alphabetical=True, notes=tuple(notes))


def splatting_renders(path: Path) -> PictureSet | None:
    """The pictures of 3DGS's ``render.py`` in a run's folder, or in one below; None without any."""
    if path.name == "renders":
        path = path.parent
    found = [path] if (path / "renders").is_dir() and (path / "gt").is_dir() else []
    for split in ("", *SPLITS):
        if not found:
            found = [step for step in (path / split).glob("ours_*") if (step / "gt").is_dir()]
    if not found:
        return None
    last = max(found, key=lambda folder: natural_key(folder.name))
    notes = [f"{last.relative_to(path)} taken"] if last != path else []
    pictures = _beside_truths(last / "renders", last / "gt")
    return PictureSet(path, "3DGS", pictures, alphabetical=True, notes=tuple(notes))


def nerfbaselines_predictions(path: Path) -> PictureSet | None:
    """The pictures of a folder or archive of predictions, or a training's last archive; or None."""
    home, notes = path, list[str]()
    if not (path / "info.json").is_file() or not (path / COLOR).is_dir():
        archives = {0: path}
        if not path.name.endswith(".tar.gz"):
            found = map(_ARCHIVE.fullmatch, (file.name for file in path.iterdir()))
            archives = {int(match[1]): path / match[0] for match in found if match}
        if not archives:
            return None
        last = archives[max(archives)]
        if last != path and len(archives) > 1:
            notes.append(f"{last.name} taken, the last of {len(archives)}")
        home = unpacked(last, whole=True)
        if not image_files(home / COLOR):
            raise ProjectError(
                f"{last}: no pictures under {COLOR}; expected predictions of NerfBaselines"
            )
    return PictureSet(path, LAYOUT, _beside_truths(home / COLOR, home / TRUTH), notes=tuple(notes))


# Recognised in this order, by what no other layout has.
READERS = (
    nerfbaselines_predictions,
    splatting_renders,
    gsplat_renders,
    nerfstudio_dataset,
    nerfstudio_evaluation,
)


def open_pictures(path: Path) -> PictureSet:
    """The pictures at ``path``, in the layout of a known tool or a plain one.

    A plain folder holds the pictures, perhaps in folders of its own. Beside ``NAME.rgb.png`` a
    ``NAME.depth.npz`` (z-depth, scene units, key ``depth``) is read, as ``gvtools render`` writes
    them; a picture ``NAME.png`` may have a ``NAME.depth.npz`` as well.
    """
    if not path.exists():
        raise ProjectError(f"{path}: no such folder; expected a folder of pictures")
    if path.is_file() and not path.name.endswith(".tar.gz"):
        raise ProjectError(
            f"{path}: is a file; expected a folder of pictures, or predictions.tar.gz of "
            "NerfBaselines"
        )
    for reader in READERS:
        if found := reader(path):
            return found
    files = image_files(path)
    if not files:
        raise ProjectError(f"{path}: no pictures; expected PNG or JPEG files")
    rendered = [file for file in files if file.name.endswith(RENDERED)]
    layout = "gvtools render" if rendered else "plain folder"
    endings = ((file, RENDERED if rendered else file.suffix) for file in rendered or files)
    return PictureSet(path, layout, tuple(_rendered(file, path, end) for file, end in endings))


def _rendered(file: Path, folder: Path, ending: str) -> MethodPicture:
    """A picture with its depth beside it, if there is any; named without ``ending``."""
    stem = file.name.removesuffix(ending)
    depth = file.with_name(f"{stem}.depth.npz")
    return MethodPicture(
        file.relative_to(folder).with_name(stem + file.suffix).as_posix(),
        lambda: replace(read_picture(file), depth=read_depth(depth) if depth.is_file() else None),
    )
