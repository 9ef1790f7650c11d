"""What is timed of a family in PyTorch, and how: the same steps for every family.

It needs torch, an optional dependency, so import this module only where it is used.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from rsjax.config import OptimizerConfig


@dataclass(frozen=True)
class TorchWork:
    """A family's networks with fixed random inputs, on a device.

    Attributes:
        trained: networks that a training step changes.
        frozen: the autoencoder's.
        loss: the loss of a batch.
        sample: generates ``sampled`` frames of each clip, the way the public code does.
        encode, decode: to tokens or latents and back, ``frames`` frames in all.
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
    work: TorchWork, optimizer: OptimizerConfig, device: str, timed: Callable[[Callable[[], Any]], float]
) -> dict[str, Any]:
    """Measures training step, sampling, encoding and decoding, in float32 and under bf16 autocast.

    Args:
        timed: takes a call and returns its median seconds.
    """
    networks = (*work.trained, *work.frozen)
    numbers: dict[str, Any] = {"torch_parameters": sum(p.numel() for net in networks for p in net.parameters())}
    for dtype in ("float32", "bfloat16"):

        def cast() -> Any:
            return torch.autocast(device, dtype=torch.bfloat16, enabled=dtype == "bfloat16")  # noqa: B023

        def seconds(call: Callable[[], Any]) -> float:
            def without_gradients() -> None:
                with torch.no_grad(), cast():
                    call()

            return timed(without_gradients)

        def loss() -> Tensor:
            with cast():
                return work.loss()

        for network in networks:
            network.train()
        adamw = make_adamw(parameters(work.trained), optimizer)
        numbers[f"torch_train_step_s_{dtype}"] = timed(
            lambda: train_step(loss, work.trained, adamw, optimizer.grad_clip)  # noqa: B023
        )
        for network in networks:
            network.eval()
        numbers[f"torch_sample_s_per_frame_{dtype}"] = seconds(work.sample) / work.sampled
        numbers[f"torch_tokenizer_encode_frames_per_s_{dtype}"] = work.frames / seconds(work.encode)
        numbers[f"torch_tokenizer_decode_frames_per_s_{dtype}"] = work.frames / seconds(work.decode)
    return numbers


def parameters(networks: Iterable[nn.Module]) -> list[nn.Parameter]:
    """Returns all parameters of some networks."""
    return [x for network in networks for x in network.parameters()]


def make_adamw(params: Iterable[nn.Parameter], optimizer: OptimizerConfig) -> Any:
    """Returns AdamW with this project's settings."""
    return torch.optim.AdamW(
        params,
        lr=optimizer.learning_rate,
        betas=(optimizer.beta1, optimizer.beta2),
        weight_decay=optimizer.weight_decay,
    )


def train_step(loss: Callable[[], Tensor], networks: Iterable[nn.Module], adamw: Any, grad_clip: float = 1.0) -> Tensor:
    """Does one step and returns the loss before it. ``grad_clip`` 0 does not clip."""
    value = loss()
    adamw.zero_grad()
    value.backward()
    if grad_clip > 0:
        nn.utils.clip_grad_norm_(parameters(networks), grad_clip)
    adamw.step()
    return value.detach()
