"""The PyTorch baseline, timed on the same machine in the same process."""

from functools import partial
from importlib.util import find_spec
from typing import Any

import jax

from rsjax.bench.plain import check_plain
from rsjax.bench.timing import median_seconds
from rsjax.config import Config, ModelConfig
from rsjax.errors import UserError


def check_torch(model: ModelConfig) -> None:
    """Raises :class:`UserError` where the model has what the baseline has not, or torch is not installed."""
    check_plain(model)
    if find_spec("torch") is None:
        raise UserError(
            "--torch needs PyTorch, which is not installed; pip install 'rsjax[torch]', or leave --torch out"
        )


def torch_baseline(config: Config, batch: int, budget: float, horizon: int) -> dict[str, Any]:
    """Training step and decoding by recomputation of the RGB branch in eager PyTorch, in float32 and bf16 autocast.

    On the accelerator where jax is on one that PyTorch can use, else on the CPU: ``torch_device`` says which. Training
    clips are as long as jax's.

    Args:
        horizon: frames of the rollout whose last frame is decoded; each step passes over its whole window.

    Raises:
        UserError: torch is not installed, or the model has what the baseline has not.
    """
    check_torch(config.model)
    import torch

    from rsjax.bench import genie_torch as genie

    device = "cuda" if jax.default_backend() == "gpu" and torch.cuda.is_available() else "cpu"
    torch.manual_seed(0)
    model = genie.GenieTorch(config.model).to(device)

    def draw(frames: int) -> torch.Tensor:
        return torch.randint(0, 2**config.model.code_bits, (batch, frames, config.model.grid**2), device=device)

    tokens = draw(config.clips.frames)
    mask = torch.rand(tokens.shape, device=device) < 0.5
    window = draw(min(horizon, config.model.frames))
    wait = torch.cuda.synchronize if device == "cuda" else lambda: None

    def timed(call: Any) -> float:
        return median_seconds(lambda: (call(), wait())[:0], budget)  # jax has nothing to wait for

    numbers: dict[str, Any] = {
        "torch": torch.__version__,
        "torch_device": device,
        "torch_threads": torch.get_num_threads(),
        "torch_parameters": sum(p.numel() for p in model.parameters()),
    }
    for dtype in ("float32", "bfloat16"):
        bf16 = dtype == "bfloat16"
        adamw = genie.make_adamw(model, config.train.optimizer)
        step = partial(genie.train_step, model, adamw, tokens, mask, bf16, config.train.optimizer.grad_clip)
        numbers[f"torch_train_step_s_{dtype}"] = timed(step)
        decode = partial(genie.decode_frame, model, window, window.shape[1] - 1, config.sample.steps, bf16)
        numbers[f"torch_sample_s_per_frame_{dtype}"] = timed(decode)
    return numbers
