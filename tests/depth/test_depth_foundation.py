"""Depth Anything 3 as a depth source, with a stand-in network that knows the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from tiny_scan import (
    SQUARE,
    WALL,
    in_another_unit,
    render,
    without_depth,
    write_colmap_scan,
    write_scan,
)

from gvtools.completers.geoverse.views import resample
from gvtools.depth import foundation as module
from gvtools.depth.choice import choose_source
from gvtools.depth.foundation import FoundationDepth
from gvtools.depth.options import FoundationOptions
from gvtools.depth.source import MixedDepth
from gvtools.errors import CheckpointError, DegenerateError
from gvtools.networks.depth_anything.encoder import EncoderConfig
from gvtools.networks.depth_anything.geometry_head import GeometryHeadConfig, ViewGeometry
from gvtools.networks.depth_anything.network import (
    RELEASED,
    DepthAnything3,
    DepthAnythingConfig,
    load_depth_anything,
)
from gvtools.scenes.colmap import read_colmap
from gvtools.scenes.rgbd_layouts import SEVENSCENES
from gvtools.scenes.scene import Scene
from pipelines.cli import main

pytestmark = pytest.mark.usefixtures("unpainted")

# What the stand-in's unit is, in scene units of the cameras that it sees.
UNIT = 1.7


class Oracle:
    """A network that recognises the pictures and answers with the true depth, in its own unit."""

    def __init__(self, scene: Scene, *, wrong: str = "") -> None:
        self.config = DepthAnythingConfig(EncoderConfig(patch=14), GeometryHeadConfig())
        self.scene, self.wrong = scene, wrong
        self.calls: list[int] = []
        self.given: list[tuple[torch.Tensor, ...]] = []

    def __call__(self, images, cam_from_world=None, K=None):
        self.given.append((images, cam_from_world, K))
        size = images.shape[-2:]
        rows = [self._recognised(image, size) for image in images[0].cpu()]
        self.calls.append(len(rows))
        views = [self.scene.views[row] for row in rows]
        first = views[0].camera.cam_from_world[0]
        depths, centres = [], []
        for view in views:
            truth = torch.from_numpy(true_depth(view))[None, None]
            depths.append(resample(truth, tuple(size))[0, 0])
            centres.append(first[:3, :3] @ view.camera.centers[0] + first[:3, 3])
        seen = self._unit(cam_from_world, np.array(centres))
        depth = torch.stack(depths)[None].float() / seen / UNIT
        ray = torch.zeros(1, len(rows), 4, 4, 6)
        ray[..., 2] = 1
        ray[..., 3:] = torch.from_numpy(np.array(centres) / seen / UNIT)[None, :, None, None]
        if self.wrong == "centres":
            ray[..., 3:] = torch.randn(ray[..., 3:].shape, generator=torch.Generator())
        if self.wrong == "depth":
            depth = torch.rand(depth.shape, generator=torch.Generator()) + 0.1
        sure = torch.full_like(depth, 5.0)
        sure[..., :7] = 1.0
        return ViewGeometry(depth, sure, ray, torch.ones(ray.shape[:-1]))

    def _recognised(self, image, size) -> int:
        gaps = []
        for view in self.scene.views:
            rgb = torch.from_numpy(view.load().rgb).permute(2, 0, 1)[None].float() / 255
            gaps.append(float((resample(rgb, tuple(size))[0] - image).abs().mean()))
        return int(np.argmin(gaps))

    def _unit(self, cam_from_world, centres) -> float:
        """The unit of the cameras that were handed in; 1 without them, or of one alone."""
        if cam_from_world is None or len(centres) == 1:
            return 1.0
        given = torch.linalg.inv(cam_from_world[0].double())[:, :3, 3].numpy()
        longest = np.linalg.norm(centres, axis=1).argmax()
        return float(np.linalg.norm(centres[longest]) / np.linalg.norm(given[longest]))


def true_depth(view) -> np.ndarray:
    """Exact depth of a view of the tiny scan."""
    return render(view.camera.world_from_cam[0])[1]


@pytest.fixture
def scene(tmp_path) -> Scene:
    return SEVENSCENES.read(write_scan(tmp_path / "scan"))


@pytest.fixture
def with_points(tmp_path) -> Scene:
    return read_colmap(write_colmap_scan(tmp_path / "colmap", points=200))


@pytest.fixture
def weights(tmp_path):
    """A file that is only looked for, not read."""
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / "model.safetensors").write_bytes(b"stand-in")
    return str(tmp_path / "weights")


def da3(scene: Scene, weights: str, **options) -> FoundationDepth:
    given = FoundationOptions(weights=weights, longest=56, **options)
    return FoundationDepth(scene, views=scene.names, options=given)


def stand_in(monkeypatch, scene: Scene, **options) -> Oracle:
    oracle = Oracle(scene, **options)
    monkeypatch.setattr(module, "load_depth_anything", lambda path, **_: oracle)
    return oracle


def relative_errors(scene: Scene, source: FoundationDepth) -> list[float]:
    found = []
    for view in scene.views:
        frame = view.load()
        made = source.depth(scene, view, replace(frame, depth=None)).depth
        known = made > 0
        assert known.mean() > 0.5
        found.append(float(np.median(np.abs(made[known] / true_depth(view)[known] - 1))))
    return found


@pytest.mark.parametrize("cameras", [True, False])
@pytest.mark.parametrize(("support", "exact"), [("points", 0.03), ("cameras", 1e-3)])
def test_sparse_points_give_the_scale_and_without_them_camera_centres(
    scene, with_points, monkeypatch, weights, cameras, support, exact
):
    scene = with_points if support == "points" else scene
    stand_in(monkeypatch, scene)
    source = da3(scene, weights, cameras=cameras)
    assert max(relative_errors(scene, source)) < 0.02
    fitted = source.scale(scene.names[0])
    assert fitted.ok and fitted.support == support
    assert fitted.count >= (50 if support == "points" else 6)
    assert fitted.scale == pytest.approx(UNIT, rel=exact)


def test_passes_share_one_scale_and_are_as_equal_as_can_be(tmp_path, monkeypatch, weights):
    scene = SEVENSCENES.read(write_scan(tmp_path / "scan", views=7))
    oracle = stand_in(monkeypatch, scene)
    source = da3(scene, weights, views=3)
    assert max(relative_errors(scene, source)) < 0.02
    assert sorted(oracle.calls) == [2, 2, 3]
    assert len({source.scale(name).scale for name in scene.names}) == 1


@pytest.mark.parametrize(
    ("wrong", "said"),
    [("centres", "unsupported"), ("depth", "unsupported"), ("", "unsupported: .*at least 4"),
     ("alone", "unsupported: fewer than 2 valid centres; give a project with")],
)  # fmt: skip
def test_a_scale_without_support_is_refused(scene, with_points, monkeypatch, weights, wrong, said):
    """Points that fit no scale refuse it, whatever the centres say; two centres or one are none."""
    few = scene.subset(scene.names[: 1 if wrong == "alone" else 2])
    scene = {"centres": scene, "depth": with_points}.get(wrong, few)
    stand_in(monkeypatch, scene, wrong=wrong)
    source = da3(scene, weights)
    view = scene.views[0]
    with pytest.raises(DegenerateError, match=said):
        source.depth(scene, view, view.load())
    fitted = source.scale(view.name)
    assert not fitted.ok
    assert fitted.support == ("points" if wrong == "depth" else "cameras")


@pytest.mark.parametrize("factor", [0.01, 100.0])
def test_the_scenes_unit_changes_the_depths_unit_alone(scene, monkeypatch, weights, factor):
    oracle, depths = stand_in(monkeypatch, scene), []
    for other in (scene, in_another_unit(scene, factor)):
        source = da3(other, weights)
        view = other.views[-1]
        depths.append(source.depth(other, view, replace(view.load(), depth=None)).depth)
    for one, two in zip(*oracle.given, strict=True):
        torch.testing.assert_close(two, one, rtol=1e-5, atol=1e-6)
    assert (depths[0] > 0).mean() > 0.5
    np.testing.assert_allclose(depths[1], factor * depths[0], rtol=1e-5)


def test_no_depth_lies_between_two_surfaces(scene, monkeypatch, weights):
    oracle = stand_in(monkeypatch, scene)
    original = Oracle.__call__

    def sharp(self, *args, **known):
        """Every pixel of the network on one of the two surfaces."""
        made = original(self, *args, **known)
        unit = made.depth.amax() / WALL
        nearer = made.depth < unit * (SQUARE + WALL) / 2
        return replace(made, depth=torch.where(nearer, unit * SQUARE, unit * WALL))

    monkeypatch.setattr(Oracle, "__call__", sharp)
    source = da3(scene, weights)
    view = scene.views[0]
    made = source.depth(scene, view, view.load()).depth
    assert oracle.calls and made.shape == view.load().rgb.shape[:2]
    found = made[made > 0]
    gaps = np.minimum(np.abs(found / SQUARE - 1), np.abs(found / WALL - 1))
    assert gaps.max() < 0.02
    assert 100 < (np.abs(found / SQUARE - 1) < 0.02).sum() < found.size / 2


def test_unsure_pixels_and_masked_ones_stay_empty(scene, monkeypatch, weights):
    stand_in(monkeypatch, scene)
    source = da3(scene, weights)
    view = scene.views[0]
    frame = view.load()
    mask = np.ones(frame.rgb.shape[:2], bool)
    mask[: len(mask) // 2] = False
    found = source.depth(scene, view, replace(frame, mask=mask))
    assert not found.depth[~mask].any()
    assert not found.depth[:, 0].any() and found.depth[-1, -1] > 0
    assert (found.confidence[found.depth > 0] > 0.2).all()


def test_choice_takes_it_when_weights_are_given(scene, weights):
    given, without = FoundationOptions(weights=weights), without_depth(scene)
    chosen = choose_source(without, scene.names, "auto", foundation=given)
    assert isinstance(chosen.source, FoundationDepth) and "weights are given" in chosen.reason
    paper = choose_source(without, scene.names, "sensor-or-da3", foundation=given)
    assert isinstance(paper.source, FoundationDepth)
    assert choose_source(scene, scene.names, "sensor-or-da3", foundation=given).source.name != "da3"
    swept = choose_source(without, scene.names, "sensor-or-da3")
    assert "as no weights of a foundation model are given" in swept.reason
    mixed = without_depth(scene, *range(1, 6))
    chosen = choose_source(mixed, scene.names, "auto", foundation=given)
    assert isinstance(chosen.source, MixedDepth) and chosen.source.files
    # A foundation model needs no second view.
    single = choose_source(without, scene.names[:1], "auto", foundation=given)
    assert isinstance(single.source, FoundationDepth)
    chosen = choose_source(scene, scene.names, "da3", foundation=given)
    assert isinstance(chosen.source, FoundationDepth)


def test_wrong_options_and_folders_are_one_clear_line(tmp_path, weights, capsys):
    with pytest.raises(CheckpointError, match=r"no model\.safetensors"):
        load_depth_anything(tmp_path)
    with pytest.raises(CheckpointError, match="cannot be read"):
        load_depth_anything(weights)
    scan = write_scan(tmp_path / "scan")
    words = f"--refine 0 --out {tmp_path / 'run'} --depth da3 --set da3.weights={tmp_path}"
    assert main(["reconstruct", str(scan), *words.split()]) == 2
    assert "model.safetensors" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_the_released_small_model_is_known_by_its_width(tmp_path):
    with torch.device("meta"):
        whole = DepthAnything3(RELEASED["DA3-SMALL"].config)
    state = whole.state_dict()
    tensors = {
        f"model.{name}": torch.zeros(t.shape, dtype=torch.float16) for name, t in state.items()
    }
    save_file(tensors, tmp_path / "model.safetensors")
    network = load_depth_anything(tmp_path)
    assert network.config == RELEASED["DA3-SMALL"].config
    assert not any(parameter.requires_grad for parameter in network.parameters())
    assert next(network.parameters()).dtype == torch.float32
