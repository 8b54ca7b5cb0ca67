"""Which back end matches, and on which device."""

from __future__ import annotations

import torch

from gvtools.depth.stereo.matching import Matcher
from gvtools.depth.stereo.matching_cpu import CpuMatcher
from gvtools.depth.stereo.matching_torch import TorchMatcher
from gvtools.depth.stereo.options import StereoOptions
from gvtools.errors import OptionError


def make_matcher(options: StereoOptions) -> tuple[Matcher, torch.device]:
    """The back end of the options, and where its tensors live."""
    if options.backend == "cpu":
        return CpuMatcher(options), torch.device("cpu")
    there = torch.cuda.is_available()
    if options.device == "cuda" and not there:
        raise OptionError("stereo device 'cuda': torch sees no CUDA device; choose 'auto' or 'cpu'")
    cuda = options.device == "cuda" or (options.device == "auto" and there)
    return TorchMatcher(options), torch.device("cuda" if cuda else "cpu")
