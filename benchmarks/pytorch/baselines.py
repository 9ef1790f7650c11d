"""Measures a family's network in PyTorch, on the same machine and in the same process as ours.

The families' modules import torch, an optional dependency; this one imports it, and them, only to measure.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import jax

from rsjax.config import Config, ConfigError, TokenModelConfig, require
from rsjax.errors import UserError
from rsjax.models.cogvideox.config import CogVideoXConfig
from rsjax.models.roboscape.architecture import Architecture
from rsjax.tools.bench.timing import median_seconds

# Options that the plain Genie lacks, of the model and of its departures.
OPTIONS = ("qk_norm", "mup")
DEPARTURES = ("more_norms", "read_previous", "rotary")
PARTS = ("second_view", "state_heads", "motion_head")  # of the network


def check_genie(config: Config) -> None:
    """Raises :class:`ConfigError` if the model has an option that the plain Genie lacks."""
    model = Architecture.create(config)
    plain = "and the PyTorch baseline is the plain Genie"
    cure = "or leave the baseline out"
    options = {f"model.public_code.{name}": getattr(model.public, name) for name in OPTIONS}
    options |= {f"model.departures.{name}": getattr(model.departures, name) for name in DEPARTURES}
    for name, is_on in options.items():
        require(not is_on, f"{name} is on, {plain}, without it; set it to False, {cure}")
    for name in PARTS:
        require(not getattr(model, name), f"the network has {name}, {plain}, without it; switch it off, {cure}")
    assert isinstance(config.model, TokenModelConfig)
    encoder = config.model.action_encoder
    require(encoder != "norms", f"model.action_encoder is {encoder}, {plain}; choose linear or mlp, {cure}")
    guidance = config.model.sample.guidance
    require(guidance == 1, f"model.sample.guidance is {guidance}, {plain}; set it to 1, {cure}")


def check_cogvideox(config: Config) -> None:
    """Raises :class:`ConfigError` if a CogVideoX has options that its baseline lacks."""
    assert isinstance(config.model, CogVideoXConfig)
    for name in ("stretch", "learned_positions"):
        require(not getattr(config.model, name), f"model.{name} is set, which the PyTorch baseline lacks; leave it out")
    ratio = config.model.mlp_ratio
    require(ratio == 4, f"model.mlp_ratio is {ratio}; the PyTorch baseline has 4; set it alike, or leave --torch out")


@dataclass(frozen=True)
class TorchBaseline:
    """A family's networks in PyTorch.

    Attributes:
        module: has a function ``create``, which returns a :class:`benchmarks.pytorch.measure.TorchWork`.
        packages: the packages that it needs besides torch.
        check: raises :class:`ConfigError` for settings that the baseline lacks.
    """

    module: str
    packages: tuple[str, ...] = ()
    check: Callable[[Config], None] = lambda config: None


FAMILIES = {
    "roboscape": TorchBaseline("benchmarks.pytorch.genie", check=check_genie),
    "genie": TorchBaseline("benchmarks.pytorch.genie", check=check_genie),
    "ivideogpt": TorchBaseline("benchmarks.pytorch.ivideogpt", ("transformers",)),
    "irasim": TorchBaseline("benchmarks.pytorch.irasim", ("diffusers",)),
    "cogvideox": TorchBaseline("benchmarks.pytorch.cogvideox", ("diffusers",), check_cogvideox),
}


def check_torch(config: Config) -> TorchBaseline:
    """Returns the baseline of the model's family.

    Raises:
        UserError: the family has no baseline, the model has options that the baseline lacks, or a package is missing.
    """
    family = config.model.family
    if family not in FAMILIES:
        raise ConfigError(f"--torch has no network of family {family!r}, only of {', '.join(FAMILIES)}")
    baseline = FAMILIES[family]
    baseline.check(config)
    if find_spec("torch") is None:
        raise UserError(
            "--torch needs PyTorch, which is not installed; pip install 'rsjax[torch]', or leave --torch out"
        )
    for package in baseline.packages:
        if find_spec(package) is None:
            raise UserError(f"--torch needs the package {package} for this family; make extras, or leave --torch out")
    return baseline


def torch_baseline(
    config: Config, batch: int, budget: float, horizon: int, compiler: str = "inductor"
) -> dict[str, Any]:
    """Measures the model in PyTorch, in float32 and under bf16 autocast, like the public code of its family.

    This covers the training step, sampling and the autoencoder; for RoboScape, only the RGB branch. All run eagerly;
    the training step is also measured compiled. PyTorch runs on the GPU if both jax and PyTorch can use one, otherwise
    on the CPU (``torch_device``).

    Args:
        budget: seconds per quantity.
        horizon: length of a rollout in frames. For RoboScape and Genie only its last frame is decoded.
        compiler: backend of ``torch.compile``.

    Raises:
        UserError: as :func:`check_torch`.
    """
    baseline = check_torch(config)
    import torch

    from benchmarks.pytorch.measure import measure

    device = "cuda" if jax.default_backend() == "gpu" and torch.cuda.is_available() else "cpu"
    wait = torch.cuda.synchronize if device == "cuda" else lambda: None

    def timed(call: Callable[[], Any]) -> float:
        return median_seconds(lambda: (call(), wait())[:0], budget)  # returns no arrays that jax could wait for

    torch.manual_seed(0)
    work = import_module(baseline.module).create(config, batch, horizon, device)
    numbers = {"torch": torch.__version__, "torch_device": device, "torch_threads": torch.get_num_threads()}
    return numbers | measure(work, config.train.optimizer, device, timed, compiler)
