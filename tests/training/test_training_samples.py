from __future__ import annotations

import pytest
import torch

from gvtools.completers.geoverse.config import named
from gvtools.errors import OptionError
from gvtools.settings import with_texts
from gvtools.training.data import TrainingSamples
from gvtools.training.options import shipped_or_read

pytestmark = pytest.mark.usefixtures("one_thread")


def samples(*settings: str) -> TrainingSamples:
    config, folder = shipped_or_read("micro")
    config = with_texts(config, list(settings))
    return TrainingSamples(config, config.network(folder))


def test_holes_reach_the_model_filled_and_marked():
    batch = samples().held_out(2)
    views = batch.views
    holes = ~views.valid[:, views.context :]
    assert holes.any()
    told = views.valid[:, views.context :].flatten(2).any(2)
    filled = views.depth[:, views.context :] > 0
    assert filled[told].all() and not filled[~told].any()
    # The fill is a guess at the truth, far better than none.
    error = (views.images - batch.images)[:, views.context :].abs().mean(2, keepdim=True)
    dark = batch.images[:, views.context :].mean(2, keepdim=True)
    assert error[holes & filled].mean() < 0.6 * dark[holes & filled].mean()


def test_without_projections_targets_are_black():
    plain, blind = samples().held_out(2), samples("data.projections=false").held_out(2)
    context = plain.views.context
    assert torch.equal(plain.images, blind.images)
    assert torch.equal(plain.views.images[:, :context], blind.views.images[:, :context])
    assert torch.equal(plain.views.depth[:, :context], blind.views.depth[:, :context])
    assert blind.views.valid[:, :context].all()
    for values in (blind.views.images, blind.views.depth, blind.views.valid):
        assert not values[:, context:].any()


def test_the_same_numbers_give_the_same_samples_and_splits_differ():
    first, again = (samples().batch(range(8, 10)) for _ in range(2))
    assert torch.equal(first.images, again.images)
    assert torch.equal(first.views.images, again.views.images)
    assert not torch.equal(first.images, samples().held_out(2).images)
    assert named("tiny").hints.fill == "surfaces"


def test_a_pool_repeats_and_its_files_decide_nothing(tmp_path):
    pool, cache = "data.pool=8", f"data.cache={tmp_path}"
    fresh = samples(pool).batch(range(2))
    made = samples(pool, cache).batch(range(2))
    again = samples(pool, cache).batch(range(8, 10))
    (folder,) = tmp_path.iterdir()
    assert len(list(folder.glob("*.npz"))) == 2
    for other in (made, again):
        assert torch.equal(fresh.images, other.images)
        assert torch.equal(fresh.depth, other.depth)
        assert torch.equal(fresh.views.images, other.views.images)
        assert torch.equal(fresh.views.valid, other.views.valid)
    exact = samples().batch(range(2))
    assert torch.equal(exact.images, fresh.images)
    assert torch.allclose(exact.depth, fresh.depth, rtol=1e-3)
    assert (exact.views.images - fresh.views.images).abs().max() <= 0.5 / 255 + 1e-6


def test_a_torn_file_of_a_pool_is_made_again_and_other_data_lie_elsewhere(tmp_path):
    pool, cache = "data.pool=8", f"data.cache={tmp_path}"
    whole = samples(pool, cache).batch(range(1))
    (file,) = tmp_path.glob("*/*.npz")
    file.write_bytes(file.read_bytes()[:1000])
    assert torch.equal(samples(pool, cache).batch(range(1)).images, whole.images)
    other = samples(pool, cache, "seed=1").batch(range(1))
    assert not torch.equal(other.images, whole.images)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_pool_that_cannot_be_is_refused():
    with pytest.raises(OptionError, match="multiple of 8, such as 16"):
        samples("data.pool=12")
