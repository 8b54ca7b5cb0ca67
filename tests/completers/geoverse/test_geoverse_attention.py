from __future__ import annotations

import pytest
import torch

from gvtools.networks.compute import attend

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]


def heads(*shape: int, dtype=torch.float64, device="cpu") -> torch.Tensor:
    generator = torch.Generator().manual_seed(sum(shape))
    return torch.randn(shape, generator=generator, dtype=torch.float64).to(device, dtype)


def spelt_out(q, k, v):
    scores = (q.double() @ k.double().mT) / q.shape[-1] ** 0.5
    return scores.softmax(-1) @ v.double()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("size", [8, 20, 72])
def test_it_is_the_softmax_of_the_products(size, dtype, device):
    q = heads(2, 3, 37, size, dtype=dtype, device=device)
    k, v = (heads(2, 3, count, size, dtype=dtype, device=device)[:, :, :51] for count in (51, 60))
    out = attend(q, k, v)
    assert out.dtype == dtype and out.shape == q.shape
    tolerance = 1e-6 if dtype == torch.float32 else 2e-2
    torch.testing.assert_close(out.double(), spelt_out(q, k, v), rtol=tolerance, atol=tolerance)


def test_gradients():
    q, k, v = (heads(1, 2, count, 4).requires_grad_() for count in (3, 5, 5))
    assert torch.autograd.gradcheck(attend, (q, k, v))


def test_ten_thousand_tokens_need_no_matrix_of_scores():
    # 16 heads of 10368 x 10368 scores would be 6.9 GB.
    q = heads(1, 1, 10368, 8, dtype=torch.float32).expand(-1, 16, -1, -1)[:, :, :64]
    k = heads(1, 1, 10368, 8, dtype=torch.float32).expand(-1, 16, -1, -1)
    torch.testing.assert_close(attend(q, k, k).double(), spelt_out(q, k, k), rtol=1e-5, atol=1e-5)
