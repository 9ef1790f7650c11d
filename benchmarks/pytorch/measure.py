"""Times a family's networks in PyTorch, with the same steps for every family.

It needs torch, an optional dependency, so import this module only where it is used.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from rsjax.config import OptimizerConfig
from rsjax.errors import first_line

FORMATS = {4: torch.channels_last, 5: torch.channels_last_3d}  # memory formats by the kernels' number of axes


@dataclass(frozen=True)
class TorchWork:
    """A family's networks with fixed random inputs, on a device.

    Attributes:
        trained: networks that a training step changes.
        frozen: the autoencoder's networks.
        loss: returns the loss of a batch.
        sample: generates ``sampled`` frames of each clip in the way of the public code.
        encode, decode: map ``frames`` frames in all to tokens or latents, and back.
    """

    trained: tuple[nn.Module, ...]
    frozen: tuple[nn.Module, ...]
    loss: Callable[[], Tensor]
    sample: Callable[[], Any]
    sampled: int
    encode: Callable[[], Any]
    decode: Callable[[], Any]
    frames: int


def measure(
    work: TorchWork,
    optimizer: OptimizerConfig,
    device: str,
    timed: Callable[[Callable[[], Any]], float],
    compiler: str = "inductor",
) -> dict[str, Any]:
    """Measures training step, sampling, encoding and decoding, in float32 and under bf16 autocast.

    Under bf16 autocast it also measures the training step with ``torch.compile``, and the autoencoder with its kernels
    in channels-last format; both change the networks, so they come last.

    Args:
        timed: takes a call and returns its median seconds.
        compiler: backend of ``torch.compile``.

    Returns:
        Numbers by name; ``torch_compile`` gives the reason if the step cannot be compiled here.
    """
    networks = (*work.trained, *work.frozen)
    numbers: dict[str, Any] = {"torch_parameters": sum(x.numel() for x in parameters(networks))}
    for dtype in ("float32", "bfloat16"):
        cast = partial(torch.autocast, device, dtype=torch.bfloat16, enabled=dtype == "bfloat16")
        numbers[f"torch_train_step_s_{dtype}"] = timed(training(work, work.loss, optimizer, cast))
        for network in networks:
            network.eval()
        seconds = partial(_seconds, cast, timed)
        numbers[f"torch_sample_s_per_frame_{dtype}"] = seconds(work.sample) / work.sampled
        numbers |= _codec_rates(work, seconds, dtype)
    to_channels_last(work.frozen)
    numbers |= _codec_rates(work, seconds, "bfloat16_channels_last")

    def compiled() -> Callable[[], Any]:
        return training(work, torch.compile(work.loss, backend=compiler), optimizer, cast)

    return numbers | _compiled(compiled, timed)


def to_channels_last(networks: Iterable[nn.Module]) -> None:
    """Stores convolution kernels in the channels-last format, which PyTorch then also uses to compute."""
    for x in parameters(networks):
        if x.dim() in FORMATS:
            x.data = x.data.contiguous(memory_format=FORMATS[x.dim()])


def training(work: TorchWork, loss: Callable[[], Tensor], optimizer: OptimizerConfig, cast: Any) -> Callable[[], Any]:
    """Returns a training step with a fresh AdamW; ``cast`` returns the context manager of its forward pass."""
    for network in (*work.trained, *work.frozen):
        network.train()
    adamw = make_adamw(parameters(work.trained), optimizer)

    def forward() -> Tensor:
        with cast():
            return loss()

    return lambda: train_step(forward, work.trained, adamw, optimizer.grad_clip)


def _seconds(cast: Any, timed: Callable[[Callable[[], Any]], float], call: Callable[[], Any]) -> float:
    def without_gradients() -> None:
        with torch.no_grad(), cast():
            call()

    return timed(without_gradients)


def _codec_rates(work: TorchWork, seconds: Callable[[Callable[[], Any]], float], name: str) -> dict[str, float]:
    return {
        f"torch_tokenizer_encode_frames_per_s_{name}": work.frames / seconds(work.encode),
        f"torch_tokenizer_decode_frames_per_s_{name}": work.frames / seconds(work.decode),
    }


def _compiled(make: Callable[[], Callable[[], Any]], timed: Callable[[Callable[[], Any]], float]) -> dict[str, Any]:
    """Measures a step that ``make`` returns: its first call, which compiles it, and later calls."""
    began = time.perf_counter()
    try:
        step = make()
        step()
    except Exception as error:  # no C++ compiler, or a network that PyTorch cannot trace
        return {"torch_compile": f"unavailable: {first_line(error)}"}
    seconds = time.perf_counter() - began
    return {"torch_compile_s": seconds, "torch_train_step_s_bfloat16_compiled": timed(step)}


def parameters(networks: Iterable[nn.Module]) -> list[nn.Parameter]:
    """Returns all parameters of some networks."""
    return [x for network in networks for x in network.parameters()]


def make_adamw(params: Iterable[nn.Parameter], optimizer: OptimizerConfig) -> Any:
    """Returns AdamW with this project's settings."""
    return torch.optim.AdamW(
        params,
        lr=optimizer.learning_rate,
        betas=optimizer.betas,
        weight_decay=optimizer.weight_decay,
    )


def train_step(loss: Callable[[], Tensor], networks: Iterable[nn.Module], adamw: Any, grad_clip: float = 1.0) -> Tensor:
    """Makes one training step and returns the loss before it. ``grad_clip`` 0 does not clip."""
    value = loss()
    adamw.zero_grad()
    value.backward()
    if grad_clip > 0:
        nn.utils.clip_grad_norm_(parameters(networks), grad_clip)
    adamw.step()
    return value.detach()
