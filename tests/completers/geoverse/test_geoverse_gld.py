"""Geometric Latent Diffusion as its authors run it: schedule, guidance, conditions, folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import geoverse_models as micro
import published_folder as published
import pytest
import torch
from geoverse_folders import BARE, CONTROL, SHARED, equal, output, report

from gvtools.completers.geoverse.config import named
from gvtools.completers.geoverse.denoiser import Positions
from gvtools.completers.geoverse.flow import (
    gld_time_grid,
    latent_shift,
    sample,
    seeded_noise,
    view_seed,
)
from gvtools.completers.geoverse.weights import config_of, from_pretrained, save_pretrained
from gvtools.errors import CheckpointError

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
            return network(x, t, conditions, positions=positions)

        found = sample(
            velocity, noise, times, cfg_scale=1.5,
            unconditional=lambda x, t: network(x, t, without, positions=elsewhere),
        )  # fmt: skip
        assert calls == pytest.approx(times[:-1])
        return found

    def noise(level):
        rows = [[view_seed(3, level, index) for index in range(latents.shape[1])]]
        return seeded_noise(latents.shape, rows, device=latents.device)

    level1 = run(model.level1, prepared.level1, dropped="new", times=FLOW.level1,
                 noise=noise("level1"))  # fmt: skip
    torch.testing.assert_close(made.level1, level1)
    conditions = model.cascade_conditions(prepared, level1)
    level0 = run(model.cascade, conditions, dropped="old", times=FLOW.cascade,
                 noise=noise("level0"))  # fmt: skip
    torch.testing.assert_close(made.level0, level0)
    plain = model.generate(views, seed=3, cascade_cfg_scale=1.0)
    assert torch.equal(plain.level1, made.level1) and not torch.equal(plain.level0, made.level0)


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


def test_published_files_alone_are_gld_and_with_a_video_model_base(tmp_path: Path):
    (tmp_path / published.LEVEL1).parent.mkdir()
    (tmp_path / published.LEVEL1).touch()
    assert config_of(tmp_path).name == "gld"
    (tmp_path / "video").mkdir()
    assert config_of(tmp_path).name == "base"


def test_a_base_begins_as_the_published_networks_without_a_video_model(tmp_path: Path):
    folder = published.write_published(micro.model(BARE), tmp_path)
    base, bare = from_pretrained(folder, config=CONTROL), from_pretrained(folder, config=BARE)
    assert base.video is None
    views = micro.batch()
    assert torch.equal(base.generate(views, seed=3).level1, bare.generate(views, seed=3).level1)
    assert report(folder, "video", CONTROL).ok
    assert "not needed" in report(folder, "video", CONTROL).summary
    # With features it is the same: the branch is untrained.
    assert torch.equal(output(from_pretrained(folder, config=CONTROL, video=False))[0],
                       output(from_pretrained(folder, config=BARE))[0])  # fmt: skip
    save_pretrained(base, tmp_path / "own")
    assert equal(from_pretrained(tmp_path / "own", video=False), base)
    assert not report(tmp_path / "own", "video").ok


def test_the_other_injection_needs_its_video_model(tmp_path: Path):
    folder = published.write_published(micro.model(BARE), tmp_path)
    assert not report(folder, "video", SHARED).ok
    with pytest.raises(CheckpointError, match=r"expected the truncated Wan2\.2-VACE"):
        from_pretrained(folder, config=SHARED)
