from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import geoverse_models as micro
import numpy as np
import pytest
import torch

from gvtools.completers import Completer, Completion, ContextView, create
from gvtools.completers.push_pull import push_pull, push_pull_depth
from gvtools.errors import OptionError, ShapeError
from gvtools.guidance import Guidance

pytest.importorskip("safetensors", reason="weights are read with safetensors")
pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.filterwarnings("error")]

NAMES = ("none", "inpaint", "decoded", "correction")
GENERATIVE = ("decoded", "correction")
SIZE = (24, 32)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    place = tmp_path_factory.mktemp("models")
    fills = {"decoded": "push-pull", "correction": "surfaces"}
    return {
        name: micro.weights_folder(
            place / name,
            micro.config(hints={"cameras": True, "fill": fill, "mask": 0.0}, composition=name),
        )
        for name, fill in fills.items()
    }


@pytest.fixture(scope="module")
def completers(folders: dict[str, Path]) -> dict[str, Completer]:
    made = {"none": create("none"), "inpaint": create("inpaint", min_support=1)}
    for name in GENERATIVE:
        weights = str(folders[name])
        made[name] = create("geoverse", weights=weights, steps=1, alignment="hint")
    return made


def complete(
    completers: dict[str, Completer], name: str, context: Sequence[ContextView], known: Guidance
) -> Completion:
    with np.errstate(all="raise", under="ignore"):
        return completers[name].complete(context, known, seed=1)


def flat(valid: np.ndarray, *, color: float = 0.4, depth: float = 3.0) -> Guidance:
    plain = micro.guidance(1, size=valid.shape)
    known = valid[None]
    return replace(
        plain,
        rgb=np.repeat(np.where(known, color, 0)[..., None], 3, -1).astype(np.float32),
        depth=np.where(known, depth, 0).astype(np.float32),
        valid=known,
        confidence=known.astype(np.float32),
        generated=np.zeros_like(known),
    )


def check(made: Completion, known: Guidance) -> None:
    for values in (made.rgb, made.depth, made.confidence):
        assert np.isfinite(values).all()
    assert made.rgb.min() >= 0 and made.rgb.max() <= 1
    assert made.depth.min() >= 0
    assert made.confidence.min() >= 0 and made.confidence.max() <= 1
    assert not made.confidence[made.depth == 0].any()
    np.testing.assert_array_equal(made.rgb[known.valid], known.rgb[known.valid])
    np.testing.assert_array_equal(made.depth[known.valid], known.depth[known.valid])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 2), (1, 40), SIZE])
def test_masks_of_nothing_everything_and_a_half_at_any_size(completers, name, size):
    half = np.zeros(size, np.bool_)
    half[:, : max(1, size[1] // 2)] = True
    context = micro.context_views(2)
    for valid in (np.zeros(size, np.bool_), np.ones(size, np.bool_), half):
        known = flat(valid)
        made = complete(completers, name, context, known)
        check(made, known)
        if name in GENERATIVE:
            # The context's own depth gives the scale where memory tells nothing.
            assert (made.depth > 0).all()
        elif name == "none" or not valid.any():
            assert not made.depth[~known.valid].any()


def test_a_constant_picture_is_continued_as_it_is(completers):
    valid = np.ones(SIZE, np.bool_)
    valid[8:16, 10:20] = False
    for color in (0.0, 0.4, 1.0):
        known = flat(valid, color=color)
        made = complete(completers, "inpaint", [], known)
        np.testing.assert_allclose(made.rgb, color, atol=1e-6)
        np.testing.assert_allclose(made.depth, 3, rtol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_no_photograph_is_enough_or_said_and_one_is_enough(completers, name):
    known = micro.guidance(1, size=SIZE)
    for context in ([], micro.context_views(1), micro.context_views(1, depth=False)):
        if not context and name in GENERATIVE:
            with pytest.raises(OptionError, match="at least one context view"):
                complete(completers, name, context, known)
            continue
        made = complete(completers, name, context, known)
        check(made, known)
        assert name == "none" or (made.depth > 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_no_target_is_an_empty_completion(completers, name):
    plain = micro.guidance(1, size=SIZE)
    none = {f: getattr(plain, f)[:0] for f in ("rgb", "depth", "valid", "confidence", "generated")}
    nothing = Guidance(plain.cameras[:0], **none)
    made = complete(completers, name, micro.context_views(1), nothing)
    assert made.rgb.shape == (0, *SIZE, 3)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("power", [-30, 30])
def test_the_unit_of_the_scene_does_not_matter(completers, name, power):
    context, known = micro.context_views(2), micro.guidance(1, size=SIZE)
    far = micro.moved(context, known, scale=10.0**power)
    made, plain = complete(completers, name, *far), complete(completers, name, context, known)
    check(made, far[1])
    np.testing.assert_allclose(made.depth / np.float32(10.0**power), plain.depth, rtol=1e-3)
    assert np.mean(np.abs(made.rgb - plain.rgb).max(-1) > 1e-3) < 0.005


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("what", "bad"), [("rgb", np.nan), ("depth", np.inf), ("confidence", np.nan)]
)
def test_memory_that_is_not_finite_is_refused_and_named_and_holes_may_hold_it(
    completers, name, what, bad
):
    known = micro.guidance(1, size=SIZE)
    context = micro.context_views(2)
    row, column = np.argwhere(known.valid[0])[5]
    damaged = {what: getattr(known, what).copy()}
    damaged[what][0, row, column] = bad
    with pytest.raises(ShapeError, match=r"view target_1_0: 1 pixel\(s\) hold NaN"):
        complete(completers, name, context, replace(known, **damaged))
    holes = {what: getattr(known, what).copy()}
    holes[what][~known.valid] = bad
    made = complete(completers, name, context, replace(known, **holes))
    plain = complete(completers, name, context, known)
    np.testing.assert_array_equal(made.rgb, plain.rgb)
    np.testing.assert_array_equal(made.depth, plain.depth)


@pytest.mark.parametrize("name", NAMES)
def test_photographs_that_are_not_finite_are_refused_and_named(completers, name):
    context = micro.context_views(2)
    context[1].rgb[3, 4, 0] = np.inf
    with pytest.raises(ShapeError, match=r"view photo_0_1: 1 pixel\(s\) hold NaN"):
        complete(completers, name, context, micro.guidance(1, size=SIZE))


@pytest.mark.parametrize("name", NAMES)
def test_depth_of_a_photograph_that_is_none_counts_as_none(completers, name):
    known = micro.guidance(1, size=SIZE)
    views = micro.context_views(2)
    damaged = [replace(v, depth=np.full(v.rgb.shape[:2], np.nan, np.float32)) for v in views]
    without = [replace(v, depth=None) for v in views]
    made, plain = (complete(completers, name, context, known) for context in (damaged, without))
    np.testing.assert_array_equal(made.rgb, plain.rgb)
    np.testing.assert_array_equal(made.depth, plain.depth)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (65, 47)])
def test_one_known_pixel_fills_everything_and_none_fills_nothing(dtype, size):
    values = torch.full((1, 2, *size), float("nan"), dtype=dtype)
    valid = torch.zeros(1, 1, *size, dtype=torch.bool)
    assert not push_pull(values, valid).any()
    assert not push_pull_depth(values[:, :1], valid).any()
    valid[..., -1, -1], values[..., -1, -1] = True, 2.5
    rounding = 4 * torch.finfo(dtype).eps
    for filled in (push_pull(values, valid), push_pull_depth(values[:, :1], valid)):
        torch.testing.assert_close(filled, torch.full_like(filled, 2.5), rtol=rounding, atol=0)
