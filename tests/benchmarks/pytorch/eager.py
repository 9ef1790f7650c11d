"""PyTorch's side of the benchmark without its compiler, which takes minutes."""

from functools import partial

from benchmarks.pytorch.baselines import torch_baseline

EAGER = partial(torch_baseline, compiler="none")
