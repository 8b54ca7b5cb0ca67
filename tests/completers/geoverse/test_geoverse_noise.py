from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gvtools.completers.geoverse.flow import seeded_noise, view_seed

NAMES = ["a", "b", "c", "d"]
GRID = (5, 4, 6)


def _noise(names: list[str], **options) -> torch.Tensor:
    return seeded_noise((1, len(names), *GRID), [[view_seed(7, n) for n in names]], **options)


@settings(deadline=None)
@given(st.permutations(NAMES), st.integers(1, 4))
def test_a_views_noise_does_not_depend_on_its_company(order, count):
    alone = {name: _noise([name])[0, 0] for name in NAMES}
    together = _noise(list(order)[:count])
    for index, name in enumerate(order[:count]):
        assert torch.equal(together[0, index], alone[name])


def test_noise_is_white_and_differs_between_views_seeds_and_draws():
    seeds = [view_seed(s, draw, n) for s in (0, 1) for draw in ("level1", "level0") for n in NAMES]
    assert len(set(seeds)) == len(seeds)
    assert all(0 <= seed < 2**63 for seed in seeds)
    noise = seeded_noise((4, 4, 8, 20, 20), [seeds[k : k + 4] for k in range(0, 16, 4)]).flatten(2)
    rows = noise.reshape(16, -1)
    assert float(rows.mean(1).abs().max()) < 5 / 3200**0.5
    assert float((rows.std(1) - 1).abs().max()) < 5 / 6400**0.5
    correlation = torch.corrcoef(rows) - torch.eye(16)
    assert float(correlation.abs().max()) < 5 / 3200**0.5


def test_an_index_is_not_its_text_and_names_do_not_run_together():
    assert (
        len({view_seed(0, 1), view_seed(0, "1"), view_seed(0, "", 1), view_seed(0, "1", "")}) == 4
    )
    assert view_seed(0, "ab", "c") != view_seed(0, "a", "bc")


def test_seeds_are_the_same_in_every_session():
    # echo -n '[0, "level1", "frame_7"]' | b2sum -l 64, without its lowest bit
    assert view_seed(0, "level1", "frame_7") == 6824952135169501610


def test_the_dtype_changes_no_draw():
    torch.testing.assert_close(_noise(NAMES, dtype=torch.float64).float(), _noise(NAMES))
    half = _noise(NAMES, dtype=torch.bfloat16)
    assert torch.equal(half, _noise(NAMES).to(torch.bfloat16))


@pytest.mark.gpu
def test_the_device_changes_no_draw():
    assert torch.equal(_noise(NAMES, device="cuda").cpu(), _noise(NAMES))


def test_the_global_generator_is_left_alone():
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    _noise(NAMES)
    assert torch.equal(torch.rand(3), expected)
