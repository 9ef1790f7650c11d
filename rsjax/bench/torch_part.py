"""Measures the PyTorch baseline on the same machine in the same process."""

from functools import partial
from importlib.util import find_spec
from typing import Any

import jax

from rsjax.bench.timing import median_seconds
from rsjax.config import Config, ConfigError, TokenModelConfig, require
from rsjax.errors import UserError
from rsjax.models.roboscape.architecture import Architecture

ADDED = ("temporal_norm", "final_norm", "qk_norm", "mup")  # options that the baseline lacks


def check_torch(config: Config) -> Architecture:
    """Returns the architecture of the PyTorch baseline.

    Raises:
        UserError: the model has options that the baseline lacks, or torch is not installed.
    """
    if not isinstance(config.model, TokenModelConfig):
        raise ConfigError(f"--torch times a Genie's network, and this model is of family {config.model.family!r}")
    arch = Architecture.create(config)
    check_plain(arch)
    if find_spec("torch") is None:
        raise UserError(
            "--torch needs PyTorch, which is not installed; pip install -e '.[torch]', or leave --torch out"
        )
    return arch


def check_plain(model: Architecture) -> None:
    """Raises :class:`ConfigError` if the model has an option that the baseline lacks."""
    plain, cure = "and the PyTorch baseline is the plain Genie", "or leave the baseline out"
    for name in ADDED:
        require(not getattr(model, name), f"model.{name} is on, {plain}, without it; set it to False, {cure}")
    problem = f"model.positions is {model.positions!r}, {plain}, which learns them; set it to 'learned', {cure}"
    require(model.positions == "learned", problem)


def torch_baseline(config: Config, batch: int, budget: float, horizon: int) -> dict[str, Any]:
    """Measures the RGB branch in eager PyTorch, float32 and bf16 autocast: training step, and decoding without a cache.

    It uses the GPU if jax and PyTorch both do, otherwise the CPU (``torch_device``).

    Args:
        horizon: length in frames of the rollout whose last frame is decoded; each step passes over its whole window.

    Raises:
        UserError: torch is not installed, or the model has options that the baseline lacks.
    """
    arch = check_torch(config)
    import torch

    from rsjax.bench import genie_torch as genie

    device = "cuda" if jax.default_backend() == "gpu" and torch.cuda.is_available() else "cpu"
    torch.manual_seed(0)
    model = genie.GenieTorch(arch).to(device)

    def draw(frames: int) -> torch.Tensor:
        return torch.randint(0, 2**arch.code_bits, (batch, frames, arch.grid**2), device=device)

    tokens = draw(config.clips.frames)
    mask = torch.rand(tokens.shape, device=device) < 0.5
    window = draw(min(horizon, arch.frames))
    wait = torch.cuda.synchronize if device == "cuda" else lambda: None

    def timed(call: Any) -> float:
        return median_seconds(lambda: (call(), wait())[:0], budget)  # jax has nothing to wait for

    numbers: dict[str, Any] = {
        "torch": torch.__version__,
        "torch_device": device,
        "torch_threads": torch.get_num_threads(),
        "torch_parameters": sum(p.numel() for p in model.parameters()),
    }
    assert isinstance(config.model, TokenModelConfig)
    steps = config.model.sample.steps
    for dtype in ("float32", "bfloat16"):
        bf16 = dtype == "bfloat16"
        adamw = genie.make_adamw(model, config.train.optimizer)
        step = partial(genie.train_step, model, adamw, tokens, mask, bf16, config.train.optimizer.grad_clip)
        numbers[f"torch_train_step_s_{dtype}"] = timed(step)
        decode = partial(genie.decode_frame, model, window, window.shape[1] - 1, steps, bf16)
        numbers[f"torch_sample_s_per_frame_{dtype}"] = timed(decode)
    return numbers
