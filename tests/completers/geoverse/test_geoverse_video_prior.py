from __future__ import annotations

import weakref
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import pytest
import tiny_wan as tiny
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gvtools.completers.geoverse.flow import view_seed
from gvtools.completers.geoverse.video_prior import (
    ROOM,
    Layout,
    VideoPrior,
    _leaves,
    packed_mask,
    resize_views,
    view_layout,
)
from gvtools.errors import CheckpointError

pytest.importorskip("diffusers", reason="the extra wan is not installed")


LAYOUTS: tuple[Layout, ...] = ("per_view", "video9", "repeat4")


class Spy:
    def __init__(self, prior: VideoPrior) -> None:
        self.clips: list[Tensor] = []
        self.calls: list[dict[str, Any]] = []
        encode = prior.networks.encode

        def encoding(clips: Tensor) -> Tensor:
            self.clips.append(clips)
            return encode(clips)

        prior.networks.encode = encoding  # type: ignore[method-assign]
        prior.networks.transformer.register_forward_pre_hook(
            lambda module, args, kwargs: self.calls.append(kwargs), with_kwargs=True
        )


@pytest.fixture(scope="module")
def network() -> Any:
    return tiny.transformer()


def pipeline_mask(mask: Tensor) -> Tensor:
    """The packing of VACE's pipelines, (F, 1, H, W) to (64, F, H / 8, W / 8)."""
    frames, _, height, width = mask.shape
    return (
        mask[:, 0]
        .view(frames, height // 8, 8, width // 8, 8)
        .permute(2, 4, 0, 1, 3)
        .reshape(64, frames, height // 8, width // 8)
    )


def block_and_hint(network: Any, run: Callable[[], object]) -> list[Tensor]:
    """Block outputs before their hints, and the hints added here, as Wan's own code does."""
    outputs: dict[int, Tensor] = {}
    hints: list[Tensor] = []
    hooks = [
        block.register_forward_hook(lambda m, a, out, i=i: outputs.__setitem__(i, out))
        for i, block in enumerate(network.blocks)
    ]
    hooks += [
        block.register_forward_hook(lambda m, a, out: hints.append(out[0]))
        for block in network.vace_blocks
    ]
    run()
    for hook in hooks:
        hook.remove()
    for layer, hint in zip(network.config.vace_layers, hints, strict=True):
        outputs[layer] = outputs[layer] + hint
    return [outputs[tap] for tap in tiny.TAPS]


@torch.no_grad()
def reference(prior: VideoPrior, images: Tensor, valid: Tensor) -> list[Tensor]:
    """The paper's appendix view by view, without noise: every latent is encoded on its own."""
    vae, network = prior.networks.vae, prior.networks.transformer
    mean, std = (torch.tensor(vae.config[f"latents_{k}"])[:, None, None] for k in ("mean", "std"))
    latents: dict[str, list[Tensor]] = {"proxy": [], "inactive": [], "reactive": []}
    for image, seen in zip(images[0], valid[0].float(), strict=True):
        m = 1 - seen
        proxy = (image * 2 - 1) * seen
        for name, picture in (
            ("proxy", proxy),
            ("inactive", proxy * (1 - m)),
            ("reactive", proxy * m),
        ):
            mode = vae.encode(picture[None, :, None]).latent_dist.mode()[0, :, 0]
            latents[name].append((mode - mean) / std)
    parts = {name: torch.stack(frames, dim=1) for name, frames in latents.items()}
    condition = torch.cat(
        [parts["inactive"], parts["reactive"], pipeline_mask(1 - valid[0].float())]
    )
    prompt = torch.cat([tiny.prompt(), torch.zeros(5, tiny.TEXT)])
    tokens = block_and_hint(
        network,
        lambda: network(
            hidden_states=parts["proxy"][None],
            timestep=torch.tensor([500.0]),
            encoder_hidden_states=prompt[None],
            control_hidden_states=condition[None],
        ),
    )
    grid = (images.shape[1], images.shape[3] // 16, images.shape[4] // 16)
    return [t.unflatten(1, grid).permute(0, 1, 4, 2, 3) for t in tokens]


def test_features_are_those_of_the_paper_and_include_the_vace_hint(network: Any) -> None:
    prior = tiny.prior(network, sigma=0.0, proxy_noise=0.0)
    images, valid = tiny.views(3)
    features = prior.features(images, valid, 1)
    expected = reference(prior, images, valid)
    for found, wanted in zip(features, expected, strict=True):
        assert found.shape == (1, 3, 48, 2, 3)
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-5)
    assert features[0].shape[3:] == (2, 3)
    # The hints are not small: without them the comparison would have failed.
    network.vace_blocks[0].proj_out.weight.data *= -1
    try:
        other = prior.features(images, valid, 1)
    finally:
        network.vace_blocks[0].proj_out.weight.data *= -1
    assert (other[0] - expected[0]).abs().max() > 0.05


def test_layouts_say_which_latent_holds_which_view() -> None:
    eight = {name: view_layout(name, 8) for name in LAYOUTS}
    assert eight["per_view"].clips == tuple((v,) for v in range(8))
    assert eight["per_view"].latent_of_view == tuple(range(8))
    assert eight["video9"].clips == ((0, 1, 2, 3, 4, 5, 6, 7, 7),)
    assert eight["video9"].views_of_latent == ((0,), (1, 2, 3, 4), (5, 6, 7))
    assert eight["video9"].latent_of_view == (0, 1, 1, 1, 1, 2, 2, 2)
    assert len(eight["repeat4"].clips[0]) == 29
    assert eight["repeat4"].latent_of_view == tuple(range(8))
    for name in LAYOUTS:
        for views in range(1, 14):
            layout = view_layout(name, views)
            assert all(len(clip) % 4 == 1 for clip in layout.clips)
            assert len(layout.latent_of_view) == views


@pytest.mark.parametrize("name", LAYOUTS)
def test_views_in_one_latent_share_features_and_others_do_not(network: Any, name: Layout) -> None:
    images, valid = tiny.views(6)
    features = tiny.prior(network, layout=name).features(images, valid, 1)
    latents = view_layout(name, 6).latent_of_view
    for tensor in features:
        assert tensor.shape == (1, 6, 48, 2, 3)
        for a in range(6):
            for b in range(a):
                same = latents[a] == latents[b]
                assert torch.equal(tensor[:, a], tensor[:, b]) == same


@pytest.mark.parametrize("name", LAYOUTS)
def test_masks_are_packed_as_in_the_pipeline_for_the_views_of_the_latent(name: Layout) -> None:
    generate = (
        torch.rand(2, 6, 1, 16, 24, generator=torch.Generator().manual_seed(0)) > 0.6
    ).float()
    layout = view_layout(name, 6)
    packed = packed_mask(generate, layout)
    for item in range(2):
        held = [generate[item, list(views)].amax(dim=0) for views in layout.views_of_latent]
        assert torch.equal(packed[item], pipeline_mask(torch.stack(held)))
    if name != "video9":
        assert torch.equal(packed[1], pipeline_mask(generate[1]))


@pytest.mark.parametrize("name", LAYOUTS)
def test_only_valid_target_pixels_are_noised_and_invalid_ones_are_zero(network, name):
    prior = tiny.prior(network, layout=name)
    spy = Spy(prior)
    images, valid = tiny.views(5, size=(48, 64))
    valid[:, 1, :, :10] = False  # a context view with a border without content
    prior.features(images, valid, 2)
    layout = view_layout(name, 5)
    frames = spy.clips[0].transpose(1, 2).flatten(0, 1)
    shown = [view for clip in layout.clips for view in clip]
    assert len(frames) == len(shown)
    noise = []
    for frame, view in zip(frames, shown, strict=True):
        seen = valid[0, view].expand(3, -1, -1)
        clean = images[0, view] * 2 - 1
        assert (frame[~seen] == 0).all()
        if view < 2:
            assert torch.equal(frame[seen], clean[seen])
        else:
            noise.append((frame - clean)[seen])
    drawn = torch.cat(noise)
    assert drawn.std() == pytest.approx(0.1, rel=0.03)
    assert drawn.mean() == pytest.approx(0, abs=0.003)
    assert (spy.clips[1] == 0).all()


def test_x_t_mixes_the_proxy_with_unit_noise_and_the_condition_stays_clean(network: Any) -> None:
    images, valid = tiny.views(4, size=(64, 64))
    calls = {}
    for sigma in (None, 0.0, 1.0):
        prior = tiny.prior(network, sigma=sigma)
        spy = Spy(prior)
        prior.features(images, valid, 1, seed=5)
        calls[sigma] = spy.calls[0]
    x = {sigma: call["hidden_states"] for sigma, call in calls.items()}
    torch.testing.assert_close(x[None], 0.5 * x[0.0] + 0.5 * x[1.0])
    assert x[1.0].std() == pytest.approx(1, rel=0.05)
    condition = calls[None]["control_hidden_states"]
    assert condition.shape == (1, 96, 4, 8, 8)
    assert torch.equal(condition[:, :16], x[0.0])
    assert torch.equal(condition, calls[1.0]["control_hidden_states"])
    assert (condition[:, 16:32] == condition[:, 16:32, :1]).all()
    assert condition[:, 16:32].abs().max() > 0.01
    assert calls[None]["timestep"].tolist() == [500.0]


def test_the_seed_decides_and_each_view_draws_for_itself(network: Any) -> None:
    prior = tiny.prior(network)
    spy = Spy(prior)
    images, valid = tiny.views(3, batch=2)
    first, again, other = (prior.features(images, valid, 1, seed=s) for s in (1, 1, 2))
    assert all(map(torch.equal, first, again))
    assert not torch.equal(first[0], other[0])
    rows = [[view_seed(seed, "frame", v) for v in range(3)] for seed in (7, 8)]
    spy.calls.clear()
    both = prior.features(images, valid, 1, seed=rows)
    for item in range(2):
        alone = prior.features(
            images[item : item + 1], valid[item : item + 1], 1, seed=rows[item:][:1]
        )
        for found, wanted in zip(alone, both, strict=True):
            torch.testing.assert_close(found[0], wanted[item], rtol=0, atol=1e-5)
    fewer = [0, 2]
    prior.features(images[:, fewer], valid[:, fewer], 1, seed=[[r[v] for v in fewer] for r in rows])
    wanted = spy.calls[0]["hidden_states"][:, :, fewer]
    assert torch.equal(spy.calls[-1]["hidden_states"], wanted)


def test_the_video_model_runs_once_and_gradients_stop_at_its_features(network: Any) -> None:
    prior = tiny.prior(network)
    spy = Spy(prior)
    images, valid = tiny.views(3)
    features = prior.features(images, valid, 1)
    kept = [t.clone() for t in features]
    adapter = nn.Conv2d(48, 4, 1)
    for _ in range(4):  # denoising steps, which also train an adapter
        adapter(features[0].flatten(0, 1)).square().sum().backward()
    assert len(spy.calls) == 1
    assert all(map(torch.equal, features, kept))
    assert adapter.weight.grad is not None
    assert not any(t.requires_grad for t in features)
    assert all(p.grad is None and not p.requires_grad for p in network.parameters())
    assert not any(m._forward_pre_hooks for m in [*network.blocks, network.norm_out])


def test_other_sizes_give_the_tokens_of_the_resolution(network: Any) -> None:
    prior = tiny.prior(network, resolution=(48, 64))
    features = prior.features(*tiny.views(2, size=(42, 56)), 1)
    assert features[0].shape[3:] == (3, 4)


@pytest.mark.parametrize("size", [(48, 64), (20, 30), (42, 56)])
def test_resizing_looks_at_no_invalid_pixel(size: tuple[int, int]) -> None:
    images, valid = tiny.views(3, size=(42, 56))
    junk = torch.where(valid, images, torch.full_like(images, float("nan")))
    seen, shown = resize_views(junk, valid, size)
    assert torch.equal(seen, resize_views(images, valid.float(), size)[0])
    assert ((seen == 0) | (shown > 0)).all()
    assert seen.max() <= images.max() + 1e-5
    nearest = F.interpolate(valid[0].float(), size=size, mode="nearest-exact")
    assert torch.equal(shown[0], nearest)
    # A flat colour stays what it is up to the border of a hole.
    flat, shown = resize_views(torch.full_like(images, 0.75), valid, size)
    torch.testing.assert_close(flat, 0.75 * shown.expand_as(flat))
    # Without holes it is plain resampling.
    whole = resize_views(images, torch.ones_like(valid), size)[0]
    plain = F.interpolate(images[0], size=size, mode="bilinear", antialias=True)
    torch.testing.assert_close(whole[0], plain)


def test_the_empty_prompt_is_not_zeros(network: Any) -> None:
    images, valid = tiny.views(2)
    empty = tiny.prior(network).features(images, valid, 1)
    zeros = tiny.prior(network, prompt="zeros").features(images, valid, 1)
    assert not torch.equal(empty[0], zeros[0])
    config = replace(tiny.CONFIG, prompt="zeros")
    without = VideoPrior(network, tiny.vae(), config=config)
    assert torch.equal(without.features(images, valid, 1)[0], zeros[0])
    with pytest.raises(CheckpointError, match="no embedding of the empty prompt"):
        VideoPrior(network, tiny.vae(), config=tiny.CONFIG)
    for shape in ((1, 9), (7, tiny.TEXT)):
        with pytest.raises(CheckpointError, match="prompt"):
            VideoPrior(network, tiny.vae(), torch.zeros(shape), config=tiny.CONFIG)


def test_a_configuration_that_does_not_fit_the_weights_is_refused(network: Any) -> None:
    with pytest.raises(CheckpointError, match="48 channels"):
        tiny.prior(network, channels=5120)
    with pytest.raises(CheckpointError, match="4 blocks"):
        tiny.prior(network, taps=(0, 4))


def test_a_copied_model_shares_its_prior(network):
    import copy

    prior = tiny.prior(network)
    assert copy.deepcopy([prior])[0] is prior


class Stream:
    """Notes when it waits for another one."""

    def __init__(self, name: str, asked: list[str]) -> None:
        self.name, self.asked = name, asked

    def wait_stream(self, other: Stream) -> None:
        self.asked.append(f"{self.name} waits for {other.name}")


@pytest.mark.parametrize("device", [torch.device("cpu", 0), torch.device("cuda", 0)])
def test_lent_weights_come_home_and_blocks_visit_one_after_the_other(network, monkeypatch, device):
    prior = tiny.prior(network)
    views = (*tiny.views(3), 1)
    wanted = prior.features(*views)
    networks, blocks = prior.networks, [*network.vace_blocks, *network.blocks]
    tensors = [t for n in (network, networks.vae) for t in (*n.parameters(), *n.buffers())]
    home = {id(tensor): tensor.data_ptr() for tensor in tensors}
    asked: list[str] = []
    copies: list[weakref.ref[Tensor]] = []
    to, empty_like, main = Tensor.to, torch.empty_like, Stream("main", asked)

    # Another place of the CPU's memory stands for a device.
    def moved(tensor: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        if args == (device,):
            assert kwargs == {"non_blocking": True}
            return tensor.clone()
        return to(tensor, *args, **kwargs)

    def made(tensor: Tensor, **kwargs: Any) -> Tensor:
        found = empty_like(tensor)
        if kwargs == {"device": device}:
            copies.append(weakref.ref(found))
        return found

    def visit(block: nn.Module, given: Any) -> None:
        gone = [p.data_ptr() != home[id(p)] for other in blocks for p in other.parameters()]
        assert sum(gone) == len(list(block.parameters()))
        held = [copy for copy in copies if copy() is not None]
        assert len(held) <= 2 * max(len(list(other.parameters())) for other in blocks)
        asked.append(f"block {blocks.index(block)}")

    monkeypatch.setattr(Tensor, "to", moved)
    monkeypatch.setattr(torch, "empty_like", made)
    monkeypatch.setattr(torch.cuda, "Stream", lambda place: Stream("aside", asked))
    monkeypatch.setattr(torch.cuda, "current_stream", lambda place: main)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: nullcontext())
    hooks = [block.register_forward_pre_hook(visit) for block in blocks]
    prior._guest = device
    found = prior.features(*views)
    for hook in hooks:
        hook.remove()
    turns = [f"block {index}" for index in range(len(blocks))]
    if device.type == "cuda":
        # A block's copy waits for the block before the last, whose memory it may take.
        pair = ["main waits for aside", "aside waits for main"]
        turns = [word for turn in turns for word in (*pair, turn)]
        turns = ["aside waits for main", *turns[:-2], turns[-1], "main waits for aside"]
    assert asked == turns
    for one, other in zip(found, wanted, strict=True):
        assert torch.equal(one, other)
    with pytest.raises(ZeroDivisionError), networks.lent(device):
        assert all(tensor.data_ptr() != home[id(tensor)] for tensor in networks._tensors())
        _ = 1 / 0
    assert [tensor.data_ptr() for tensor in tensors] == list(home.values())
    assert [*network.vace_blocks, *network.blocks] == blocks


@pytest.mark.parametrize(
    ("device", "offload", "free", "leaves"),
    [
        ("cpu", "always", 0, False),
        ("cuda", "never", 0, False),
        ("cuda", "always", 1e12, True),
        ("cuda", "auto", 1e12, False),
        ("cuda", "auto", ROOM + 999, True),
        ("cuda", "auto", ROOM + 1000, False),
    ],
)
def test_weights_leave_where_a_pass_would_lack_room(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch, device: str, offload: str, *, free: float,
    leaves: bool,
) -> None:  # fmt: skip
    (tmp_path / "vae").mkdir()
    (tmp_path / "vae" / "x.safetensors").write_bytes(bytes(1000))
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda place: (free, 1e12))
    assert _leaves(tmp_path, device, offload) is leaves
