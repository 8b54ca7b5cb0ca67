from __future__ import annotations

import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import geoverse_models as micro
import published_folder as published
import pytest
import torch
from geoverse_folders import BARE, CONTROL, SHARED, equal, output, report
from torch import Tensor

from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.config import FlowConfig, named
from gvtools.completers.geoverse.denoiser import Denoiser, Positions
from gvtools.completers.geoverse.flow import (
    gld_time_grid,
    latent_shift,
    sample,
    seeded_noise,
    view_seed,
)
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.objective import center_similarity, depth_loss, rgb_loss
from gvtools.completers.geoverse.video_prior import VideoFeatures
from gvtools.completers.geoverse.weights import (
    config_of,
    from_pretrained,
    save_pretrained,
    untrained_branches,
)
from gvtools.errors import CheckpointError
from gvtools.networks.depth_anything.geometry_head import camera_centres
from gvtools.networks.depth_anything.network import DepthAnything3

INJECTIONS = ("none", "control", "shared")
BOUNDS = (1.0, 0.7, 0.5, 0.2, 0.0)


def built(injection: str = "none", **changes: Any) -> GeoVerse:
    model: GeoVerse = micro.model(micro.config(injection=injection, **changes))
    return model


def features(injection: str, batch: ViewBatch) -> VideoFeatures | None:
    return None if injection == "none" else micro.video_features(*batch.images.shape[:2])


def counted(monkeypatch: pytest.MonkeyPatch, kind: type, name: str) -> list[Any]:
    """The objects that a method was called on."""
    calls: list[Any] = []
    method = getattr(kind, name)

    def wrapper(self: Any, *args: Any, **options: Any) -> Any:
        calls.append(self)
        return method(self, *args, **options)

    monkeypatch.setattr(kind, name, wrapper)
    return calls


@pytest.mark.parametrize("injection", INJECTIONS)
def test_the_seed_is_all_the_chance_there_is(injection):
    model, batch = built(injection), micro.batch(1)
    video = features(injection, batch)
    first = model.generate(batch, seed=3, video=video)
    torch.manual_seed(99)
    torch.rand(5)
    again = model.generate(batch, seed=3, video=video)
    other = model.generate(batch, seed=4, video=video)
    for name in ("level1", "level0"):
        assert torch.equal(getattr(again, name), getattr(first, name))
        assert (getattr(other, name) - getattr(first, name)).abs().max() > 0.01
    assert torch.equal(again.decoded.rgb, first.decoded.rgb)


def first_states(model: GeoVerse, batch: ViewBatch, **options: Any) -> dict[str, Tensor]:
    seen: dict[str, Tensor] = {}

    def look(net: Any, args: Any) -> None:
        seen.setdefault("level1" if net is model.level1 else "level0", args[0].clone())

    assert model.cascade is not None
    hooks = [net.register_forward_pre_hook(look) for net in (model.level1, model.cascade)]
    model.generate(batch, **options)
    for hook in hooks:
        hook.remove()
    return seen


def test_the_noise_of_a_view_goes_by_its_name_alone():
    model = built()
    batch = micro.batch(1, context=2, targets=2)
    names = ["a", "b", "c", "d"]
    states = first_states(model, batch, names=[names])
    order = [1, 0, 3, 2]
    permuted = first_states(model, batch, names=[[names[index] for index in order]])
    longer = first_states(model, micro.batch(1, targets=3), names=[[*names, "e"]])
    for key, state in states.items():
        assert torch.equal(permuted[key], state[:, order])
        assert torch.equal(longer[key][:, :4], state)
        assert (state[:, 0] - state[:, 1]).std() > 1
    assert (states["level1"] - states["level0"]).std() > 1


def test_one_evaluation_an_interval_and_everything_else_once(monkeypatch):
    model, batch = built("control"), micro.batch(1)
    assert model.control is not None

    class Prior:
        calls = 0

        def features(self, images, valid, context, *, seed):
            assert torch.equal(images, batch.images) and torch.equal(valid, batch.valid)
            assert (context, len(seed), len(seed[0])) == (2, 1, 4)
            Prior.calls += 1
            return micro.video_features(1, 4)

    model.attach_video(Prior())  # type: ignore[arg-type]
    denoisers = counted(monkeypatch, Denoiser, "forward")
    encodings = counted(monkeypatch, DepthAnything3, "encode")
    adapted = counted(monkeypatch, type(model.control), "adapted")
    residuals = counted(monkeypatch, type(model.control), "forward")
    model.generate(batch, bounds=BOUNDS, cascade_bounds=(1.0, 0.5, 0.0))
    assert [net is model.level1 for net in denoisers] == [True] * 4 + [False] * 2
    assert Prior.calls == len(adapted) == 1
    assert len(residuals) == 4
    # Jointly; the context for the cascade; its first view for token 0.
    assert len(encodings) == 3
    denoisers.clear()
    model.generate(batch)
    assert [net is model.level1 for net in denoisers] == [True] * 3 + [False]


@torch.no_grad()
@pytest.mark.parametrize(
    ("interval", "level1", "level0"), [(0.0, 4, 3), (0.25, 3, 3), (0.35, 2, 3), (1.0, 1, 1)]
)
def test_encoders_run_where_time_is_far_enough_from_their_last_run(interval, level1, level0):
    model, batch = built("control"), micro.batch(1)
    assert model.control is not None and model.cascade is not None
    # An encoder that asks neither for the time nor for the state says the same at every step.
    for block in model.cascade.blocks[: model.cascade.config.depth]:
        torch.nn.init.zeros_(block.get_parameter("adaLN_modulation.1.weight"))
    runs: Counter[str] = Counter()
    nets = {"encoder": model.level1.blocks[0], "head": model.level1.blocks[-1]}
    nets |= {"control": model.control.blocks[0]}
    nets |= {"encoder0": model.cascade.blocks[0], "head0": model.cascade.blocks[-1]}
    options: dict[str, Any] = {"bounds": BOUNDS, "cascade_bounds": (1.0, 0.6, 0.2, 0.0)}
    options |= {"cfg_scale": 1.5, "video": micro.video_features(1, 4)}
    every = model.generate(batch, **options)
    hooks = [
        net.register_forward_hook(lambda *_, name=name: runs.update([name]))
        for name, net in nets.items()
    ]
    found = model.generate(batch, encoder_interval=interval, **options)
    for hook in hooks:
        hook.remove()
    assert runs == {"encoder": level1, "control": level1, "head": 4, "encoder0": level0, "head0": 3}
    assert torch.equal(found.level1, every.level1) == (level1 == 4)
    if level1 == 4:
        assert torch.equal(found.level0, every.level0)
        return
    prepared = model.prepare(batch, video=options["video"])
    noise = torch.randn(every.level0.shape, generator=torch.Generator().manual_seed(0))
    once, thrice = (
        model.sample0(
            prepared, every.level1, noise, bounds=(1.0, 0.6, 0.2, 0.0), encoder_interval=kept
        )
        for kept in (1.0, 0.0)
    )
    assert torch.equal(once, thrice)


def skipping(**flow: Any) -> GeoVerse:
    model = built(
        flow=FlowConfig(prediction="clean", **flow), hints={"fill": "push-pull", "mask": 0.0}
    )
    for parameter in model.level1.final_layer.linear.parameters():
        parameter.data.zero_()
    return model


@pytest.mark.parametrize(
    "bounds", [(1.0, 0.0), (1.0, 0.2, 0.05, 0.0), pytest.param(50, marks=pytest.mark.slow)]
)
def test_a_skip_starts_at_the_hint_whatever_the_steps(bounds):
    model, batch = skipping(skip=True), micro.batch(2)
    if isinstance(bounds, int):
        bounds = tuple(1 - index / bounds for index in range(bounds + 1))
    prepared = model.prepare(batch)
    made = model.generate(batch, bounds=bounds)
    hint = prepared.hints.unmasked
    torch.testing.assert_close(made.level1, hint, rtol=1e-4, atol=1e-4)
    with torch.no_grad():
        expected = model.decode(prepared, made.level0, hint)
    torch.testing.assert_close(made.decoded.rgb, expected.rgb, rtol=1e-3, atol=1e-3)
    assert hint[:, 2:].std() > 0.5
    nothing = skipping(skip=False).generate(batch, bounds=bounds)
    torch.testing.assert_close(nothing.level1, torch.zeros_like(hint), rtol=0, atol=1e-4)


@torch.no_grad()
def test_a_clean_prediction_is_where_its_velocity_leads():
    model = built(flow=FlowConfig(prediction="clean"))
    prepared = model.prepare(micro.batch(2))
    state = torch.randn(prepared.hints.level1.shape, generator=torch.Generator().manual_seed(0))
    t = torch.tensor([0.3, 0.01])
    clean = model.level1(state, t, prepared.level1)
    velocity = model.velocity1(prepared, state, t)
    torch.testing.assert_close(velocity[0], (state - clean)[0] / 0.3)
    torch.testing.assert_close(velocity[1], (state - clean)[1] / 0.05)
    velocity = model.velocity1(prepared, state, t, least=0.01)
    torch.testing.assert_close(state[1] - 0.01 * velocity[1], clean[1], rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_decoded_clean_latents_are_what_the_frozen_model_sees():
    model = built(hints={"token": "own"})
    batch = micro.batch(2)
    batch = replace(
        batch, images=torch.rand(batch.images.shape), valid=torch.ones_like(batch.valid)
    )
    level0, level1 = model.clean_latents(batch)
    prepared = model.prepare(batch)
    decoded = model.decode(prepared, level0, level1)
    whole = model.geometry(batch.images)
    for name in ("depth", "depth_confidence", "ray", "ray_confidence"):
        torch.testing.assert_close(
            getattr(decoded.geometry, name), getattr(whole, name), rtol=1e-4, atol=1e-4
        )
    alone = model.decode(prepared, level0, level1, targets_alone=True)
    torch.testing.assert_close(alone.depth, decoded.geometry.depth[:, 2:])
    torch.testing.assert_close(alone.depth_confidence, decoded.geometry.depth_confidence[:, 2:])
    assert torch.equal(alone.rgb, decoded.rgb)
    pyramid = model.geometry.encode(batch.images)
    normed = [model.geometry.encoder.normed(level[:, 2:, 1:]) for level in pyramid]
    rgb = model.rgb_head(torch.cat(normed, -1).flatten(0, 1), micro.GRID).unflatten(0, (2, 2))
    torch.testing.assert_close(decoded.rgb, rgb, rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_the_cascade_knows_level_1_the_contexts_level_0_and_cameras_alone():
    model, batch = built(), micro.batch(1)
    prepared = model.prepare(batch)
    level1 = torch.randn_like(prepared.hints.level1)
    known = model.cascade_conditions(prepared, level1)
    assert known.source is level1 and known.depth is None
    assert known.latents is prepared.hints.level0
    assert known.camera is prepared.level1.camera
    noise = torch.randn_like(level1)
    one = model.sample0(prepared, level1, noise)
    assert model.cascade is not None
    torch.testing.assert_close(one, noise - model.cascade(noise, torch.ones(1), known))
    bare = built(cascade=None)
    assert not bare.sample0(bare.prepare(batch), level1, noise).any()
    assert bare.generate(batch).decoded.rgb.isfinite().all()


@pytest.mark.parametrize("injection", INJECTIONS)
def test_losses_of_pictures_and_depth_reach_what_is_trained_and_nothing_else(injection):
    model, batch = built(injection), micro.batch(1)
    if model.shared is not None and model.config.shared.gated:
        model.shared.gates.data.fill_(0.5)
    if model.control is not None:
        micro.awake(model.control, seed=3)
    model.train()
    prepared = model.prepare(batch, video=features(injection, batch))
    noise = torch.randn(prepared.hints.level1.shape, generator=torch.Generator().manual_seed(0))
    for part in ("rgb", "depth"):
        model.zero_grad(set_to_none=True)
        level1 = model.sample1(prepared, noise)
        decoded = model.decode(prepared, model.sample0(prepared, level1, noise), level1)
        geometry = decoded.geometry
        if part == "rgb":
            loss = rgb_loss(decoded.rgb, torch.rand(decoded.rgb.shape)).mean()
        else:
            centres = camera_centres(geometry.ray, geometry.ray_confidence)
            known = torch.linalg.inv(batch.cam_from_world)[..., :3, 3]
            similarity = center_similarity(centres, known)
            depth = torch.full(geometry.depth[:, 2:].shape, 3.0)
            loss = depth_loss(geometry.depth[:, 2:], depth, similarity=similarity).mean()
        # Video keys hang on the features' own graph, which the first loss has used up.
        loss.backward(retain_graph=True)
        for name, parameter in model.named_parameters():
            frozen = name.startswith(("geometry.", "rgb_head.")) or name.endswith("t_embedder.W")
            assert parameter.requires_grad is not frozen, name
            if frozen:
                assert parameter.grad is None, name
            else:
                assert parameter.grad is not None and parameter.grad.any(), (part, name)
                assert parameter.grad.isfinite().all(), (part, name)


@pytest.mark.parametrize("part", ["rgb", "depth", "ray"])
def test_the_way_through_the_frozen_blocks_alone_has_gradients(part):
    """Levels 2 and 3 are propagated from level 1: without a cascade there is no other way."""
    model, batch = built(cascade=None), micro.batch(1)
    prepared = model.prepare(batch)
    noise = torch.randn(prepared.hints.level1.shape, generator=torch.Generator().manual_seed(0))
    level1 = model.sample1(prepared, noise)
    level1.retain_grad()
    decoded = model.decode(prepared, torch.zeros_like(level1), level1)
    value = decoded.rgb if part == "rgb" else getattr(decoded.geometry, part)
    value[:, -1].square().mean().backward()
    assert level1.grad is not None
    # Global attention: pictures of one view hang on the features of all.
    assert level1.grad.flatten(2).any(2).all()
    weight = model.level1.final_layer.linear.weight
    assert isinstance(weight, Tensor) and weight.grad is not None and weight.grad.any()


BARE_INSTALLATION = """
import importlib.abc, sys

absent = ("open3d", "pycolmap", "scipy", "numba", "safetensors", "diffusers", "PIL", "cv2",
          "pydantic", "tqdm", "requests")

class Refusal(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in absent:
            raise ImportError(f"{name} is refused")

sys.meta_path.insert(0, Refusal())
import gvtools.completers.geoverse as geoverse
import gvtools.completers.geoverse.wan_checkpoint
import torch
import geoverse_models as micro
made = micro.model().generate(micro.batch(1))
assert made.decoded.rgb.isfinite().all()
assert not torch.cuda.is_initialized()
print("ran")
"""


def test_torch_and_numpy_are_all_that_is_needed():
    done = subprocess.run(
        [sys.executable, "-c", BARE_INSTALLATION],
        capture_output=True,
        text=True,
        check=False,
        env={
            "PYTHONPATH": str(Path(__file__).parents[2] / "fixtures"),
            "PATH": "",
            "OMP_NUM_THREADS": "1",
        },
        cwd=Path(__file__).parents[3],
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.strip() == "ran"


@pytest.mark.parametrize("injection", ["control", "shared"])
def test_a_pass_needs_the_video_prior_of_its_configuration(injection):
    model, plain = built(injection), built()
    plain.load_state_dict(model.state_dict(), strict=False)
    batch = micro.batch()
    with pytest.raises(CheckpointError):
        model.generate(batch, seed=1)
    wanted = plain.generate(batch, seed=1)
    with_prior = model.generate(batch, seed=1, video=features(injection, batch))
    assert not torch.equal(with_prior.level1, wanted.level1)


GLD = named("gld")
FLOW = replace(GLD.flow, level1=gld_time_grid(6, shift=3.0), cascade=gld_time_grid(5, shift=3.0))
MICRO = replace(micro.config(hints={"encode": "context"}), level1=BARE.level1, flow=FLOW)


def test_the_schedule_is_that_of_its_evaluation():
    shift = latent_shift(1536 * 18 * 18 * 8)
    assert GLD.flow.level1 == pytest.approx(gld_time_grid(50, shift=shift), abs=1e-12)
    assert GLD.flow.cascade == GLD.flow.level1 and GLD.flow.sampling_shift == shift
    assert GLD.flow.shift == latent_shift(768 * 16 * 16 * 8)
    assert GLD.flow.cfg_scale == GLD.flow.cascade_cfg_scale == 1.5
    assert GLD.video is None and not GLD.level1.depth_condition


@torch.no_grad()
def test_both_levels_are_sampled_with_guidance_along_its_grid():
    model, views = micro.model(MICRO), micro.batch()
    made = model.generate(views, seed=3)
    prepared = model.prepare(views)
    latents = prepared.hints.level1
    grid = (latents.shape[-2], latents.shape[-1])

    def run(network, conditions, *, dropped, times, noise):
        positions = Positions(network.config, conditions.camera, grid)
        without = replace(conditions, camera=conditions.camera.unconditional(dropped))
        elsewhere = Positions(network.config, without.camera, grid)
        calls = []

        def velocity(x, t):
            calls.append(float(t[0]))
            given = network(x, t, conditions, positions=positions)
            bare = network(x, t, without, positions=elsewhere)
            return bare + 1.5 * (given - bare)

        found = sample(velocity, noise, times)
        assert calls == pytest.approx(times[:-1])
        return found

    def noise(level):
        rows = [[view_seed(3, level, index) for index in range(latents.shape[1])]]
        return seeded_noise(latents.shape, rows, device=latents.device)

    level1 = run(model.level1, prepared.level1, dropped="new", times=FLOW.level1,
                 noise=noise("level1"))  # fmt: skip
    torch.testing.assert_close(made.level1, level1, rtol=1e-5, atol=1e-5)
    conditions = model.cascade_conditions(prepared, level1)
    level0 = run(model.cascade, conditions, dropped="old", times=FLOW.cascade,
                 noise=noise("level0"))  # fmt: skip
    torch.testing.assert_close(made.level0, level0, rtol=1e-5, atol=1e-5)
    plain = model.generate(views, seed=3, cascade_cfg_scale=1.0)
    assert torch.equal(plain.level1, made.level1) and not torch.equal(plain.level0, made.level0)


@torch.no_grad()
@pytest.mark.parametrize("injection", ["none", "control", "shared"])
def test_guidance_in_one_batch_is_that_of_two_passes(injection):
    flow = replace(micro.CONFIG.flow, prediction="clean", skip=True, level1=(1.0, 0.5, 0.0))
    model = micro.model(replace(micro.config(injection=injection), flow=flow))
    if model.shared is not None:
        model.shared.gates.fill_(0.7)
    video = None if injection == "none" else micro.video_features(2, 4)
    prepared = model.prepare(micro.batch(2), video=video)
    bare = model.without_cameras(prepared)
    noise = torch.randn(prepared.hints.level1.shape, generator=torch.Generator().manual_seed(0))

    def velocity(x, t):
        given, without = (model.velocity1(known, x, t) for known in (prepared, bare))
        return without + 1.5 * (given - without)

    wanted = sample(velocity, noise, flow.level1)
    found = model.sample1(prepared, noise, cfg_scale=1.5)
    torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-5)
    assert float((found - model.sample1(prepared, noise)).abs().max()) > 1e-3


def test_it_sees_the_context_and_no_projections():
    model, views = micro.model(MICRO), micro.batch()
    empty = replace(
        views,
        images=torch.cat((views.images[:, :2], 0 * views.images[:, 2:]), dim=1),
        depth=torch.cat((views.depth[:, :2], 0 * views.depth[:, 2:]), dim=1),
        valid=torch.cat((views.valid[:, :2], views.valid[:, 2:] & False), dim=1),
    )
    assert torch.equal(model.generate(views).level1, model.generate(empty).level1)
    assert not model.prepare(views).hints.level1[:, 2:].any()
    jointly = micro.model(replace(MICRO, hints=replace(MICRO.hints, encode="jointly")))
    assert not torch.equal(jointly.generate(views).level1, jointly.generate(empty).level1)


def test_published_files_are_gld_with_and_without_a_video_model(tmp_path: Path):
    (tmp_path / published.LEVEL1).parent.mkdir()
    (tmp_path / published.LEVEL1).touch()
    assert config_of(tmp_path).name == "gld"
    (tmp_path / "video").mkdir()
    config = config_of(tmp_path)
    assert config.name == "gld" and len(config.flow.level1) == 50 and config.flow.cfg_scale == 1.5
    notes = untrained_branches(tmp_path, config)
    assert "trained without a memory" in notes[0] and "neither loaded nor run" in notes[1]
    assert untrained_branches(tmp_path, CONTROL)[0].endswith("untrained and has no effect")


def test_a_base_begins_as_the_published_networks_without_a_video_model(folder, tmp_path):
    base, bare = from_pretrained(folder, config=CONTROL), from_pretrained(folder, config=BARE)
    assert base.video is None
    views = micro.batch()
    assert torch.equal(base.generate(views, seed=3).level1, bare.generate(views, seed=3).level1)
    assert report(folder, "video", CONTROL).ok
    assert "not needed" in report(folder, "video", CONTROL).summary
    # With features it is the same: the branch is untrained.
    assert torch.equal(output(base)[0], output(bare)[0])
    save_pretrained(base, tmp_path / "own")
    assert equal(from_pretrained(tmp_path / "own", video=False), base)
    own = tmp_path / "own"
    (own / "video").mkdir()
    assert from_pretrained(own).without_video
    assert [note.partition(":")[2][:29] for note in untrained_branches(own, CONTROL)] == [
        " the embedder of projected de", " neither loaded nor run, as t",
    ]  # fmt: skip
    assert base.control is not None
    torch.nn.init.ones_(next(base.control.outputs.parameters()))
    torch.nn.init.ones_(next(iter(base.level1.depth_embedder.parameters())))
    save_pretrained(base, own)
    assert not report(own, "video").ok and not untrained_branches(own, CONTROL)
    with pytest.raises(CheckpointError):
        from_pretrained(own)


@pytest.mark.parametrize("gated", [False, True])
def test_the_other_injection_needs_its_video_model_where_its_gates_are_open(source, gated):
    config = replace(SHARED, shared=replace(SHARED.shared, gated=gated))
    assert report(source, "video", config).ok == gated
    if gated:
        assert from_pretrained(source, config=config).without_video
    for video in (True,) if gated else (True, None):
        with pytest.raises(CheckpointError, match=r"expected the truncated Wan2\.2-VACE"):
            from_pretrained(source, config=config, video=video)
