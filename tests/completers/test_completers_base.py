from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest

from gvtools.cameras import Cameras
from gvtools.completers import Completer, Completion, ContextView, available, create, register
from gvtools.completers.base import _FACTORIES
from gvtools.errors import OptionError, ShapeError
from gvtools.guidance import Guidance


@dataclass(frozen=True)
class _Painter:
    strength: float
    rounds: int = 2
    soft: bool = False
    limit: float | None = None
    name = "painter"

    def complete(self, context, guidance, *, seed=0):
        return Completion(guidance.rgb, guidance.depth, guidance.confidence)


@pytest.fixture
def painter():
    register("painter", _Painter)
    yield
    del _FACTORIES["painter"]


def _camera(width: int = 8, height: int = 6) -> Cameras:
    K = np.array([[[10.0, 0, width / 2], [0, 10, height / 2], [0, 0, 1]]])
    return Cameras(K, np.eye(4)[None], np.array([width]), np.array([height]), ("a",))


# One that reads weights is created with a folder of them, in its own tests.
@pytest.mark.parametrize("name", [name for name in available() if name != "geoverse"])
def test_every_registered_name_creates_a_completer_of_that_name(name):
    completer = create(name)
    assert isinstance(completer, Completer)
    assert completer.name == name


def test_listing_the_completers_imports_none_of_them():
    code = (
        "import sys, gvtools.completers as c; c.available();"
        "bad = [m for m in ('numba', 'scipy', 'torch', 'open3d', 'gvtools.completers.inpaint')"
        " if m in sys.modules]; sys.exit(' '.join(bad) or 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_texts_become_the_types_of_the_fields(painter):
    made = create("painter", strength="0.25", rounds="3", soft="true", limit="none")
    assert made == _Painter(0.25, 3, True, None)
    whole = create("painter", strength=1, limit="2")
    assert whole == _Painter(1.0, limit=2.0)
    assert isinstance(vars(whole)["strength"], float)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"strenght": 1}, "'strength'"),
        ({}, "required"),
        ({"strength": "much"}, "expected float"),
        ({"strength": 1, "rounds": 2.5}, "expected int"),
        ({"strength": 1, "soft": "maybe"}, "expected bool"),
    ],
)
def test_wrong_options_are_named(painter, options, words):
    with pytest.raises(OptionError, match=words):
        create("painter", **options)


def test_an_unknown_name_meets_the_nearest_known():
    with pytest.raises(OptionError, match="did you mean 'inpaint'"):
        create("inpant")
    with pytest.raises(OptionError, match="it has no options"):
        create("none", strength=1)


def test_a_taken_name_and_a_malformed_reference_are_refused(painter):
    register("painter", _Painter)
    with pytest.raises(OptionError, match="taken"):
        register("painter", "other:Thing")
    with pytest.raises(OptionError, match="module:attribute"):
        register("other", "no_colon")


def test_none_passes_valid_pixels_and_leaves_the_rest_empty():
    rng = np.random.default_rng(0)
    valid = rng.random((2, 6, 8)) < 0.5
    camera = _camera()
    cameras = camera[[0, 0]]
    guidance = Guidance(
        cameras,
        rng.random((2, 6, 8, 3), np.float32),
        rng.random((2, 6, 8), np.float32) + 1,
        valid,
        3 * rng.random((2, 6, 8), np.float32),
        np.zeros_like(valid),
    )
    result = create("none").complete([], guidance)
    assert np.array_equal(result.rgb[valid], guidance.rgb[valid])
    assert np.array_equal(result.depth[valid], guidance.depth[valid])
    assert not result.rgb[~valid].any() and not result.depth[~valid].any()
    assert not result.confidence[~valid].any()
    assert result.confidence.max() <= 1
    assert result.spent["holes"] == (~valid).sum()


def test_shapes_that_do_not_fit_are_refused():
    image = np.zeros((6, 8, 3), np.float32)
    with pytest.raises(ShapeError, match="expected one camera"):
        ContextView("a", _camera(9), image)
    with pytest.raises(ShapeError, match="depth"):
        ContextView("a", _camera(), image, np.zeros((6, 7), np.float32))
    with pytest.raises(ShapeError, match="completion"):
        Completion(image, image[..., 0], image[..., 0])
