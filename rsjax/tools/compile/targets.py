"""Clusters of accelerators, named as users name them: ``h100x8``, ``v5e-16``."""

import re
from dataclasses import dataclass
from typing import Any

from rsjax.config import ConfigError
from rsjax.errors import did_you_mean
from rsjax.tools.compile.cards import CARDS, Card

GPUS_PER_HOST = 8

# Shapes of the slices that can be rented, by the number in their name: of chips (v5e, v6e), or of cores, two of which
# are in each chip (v4, v5p).
_FLAT = {1: "1x1", 4: "2x2", 8: "2x4", 16: "4x4", 32: "4x8", 64: "8x8", 128: "8x16", 256: "16x16"}
_CUBES = {
    8: "2x2x1",
    16: "2x2x2",
    32: "2x2x4",
    64: "2x4x4",
    128: "4x4x4",
    256: "4x4x8",
    512: "4x8x8",
    1024: "8x8x8",
    2048: "8x8x16",
}
SLICES = {"v4": _CUBES, "v5e": _FLAT, "v5p": _CUBES, "v6e": _FLAT}

# Without these, jax looks for a GPU, and libtpu for the machines of a TPU; the rest keeps their logs short.
ENVIRONMENT = {
    "JAX_PLATFORMS": "cpu",
    "TPU_SKIP_MDS_QUERY": "1",
    "TPU_ACCELERATOR_TYPE": "v5litepod-4",
    "TPU_WORKER_HOSTNAMES": "localhost",
    "ALLOW_MULTIPLE_LIBTPU_LOAD": "1",  # several commands at once
    "TPU_STDERR_LOG_LEVEL": "3",
    "TF_CPP_MIN_LOG_LEVEL": "3",
}


@dataclass(frozen=True)
class Target:
    """A cluster: ``hosts`` machines with ``local`` devices each.

    Attributes:
        shape: of a TPU's slice, such as ``4x4``.
    """

    name: str
    card: Card
    hosts: int
    local: int
    shape: str = ""

    @property
    def devices(self) -> int:
        """The number of devices."""
        return self.hosts * self.local

    @property
    def title(self) -> str:
        """The devices in words."""
        hosts = ""
        if self.hosts > 1:
            hosts = f" on {self.hosts} hosts"
        return f"{self.devices} × {self.card.title}{hosts}"


def find(name: str) -> Target:
    """Returns the cluster of this name.

    Raises:
        ConfigError: there is none; the message lists all.
    """
    for family, card in CARDS.items():
        parts = re.fullmatch(rf"{family}(?:[x-](\d+))?", name)
        if parts is None:
            continue
        if card.platform == "tpu":
            return _slice(name, family, parts[1])
        return _gpus(name, family, int(parts[1] or 1))
    gpus = [name for name, card in CARDS.items() if card.platform == "cuda"]
    slices = [f"{family}-{size}" for family, sizes in SLICES.items() for size in sizes]
    near = did_you_mean(name, [*CARDS, *(f"{gpu}x{size}" for gpu in gpus for size in (2, 4, 8, 16, 64)), *slices])
    named = [
        *(f"{gpu}, {gpu}xN" for gpu in gpus),
        *(f"{tpu}-{min(each)} to -{max(each)}" for tpu, each in SLICES.items()),
    ]
    raise ConfigError(f"target {name!r} is not known{near}; targets: {', '.join(named)}")


def _gpus(name: str, family: str, devices: int) -> Target:
    local = max(1, min(devices, GPUS_PER_HOST))
    if devices == 0 or devices % local:
        raise ConfigError(
            f"target {name!r}: a host has up to {GPUS_PER_HOST} cards, so several hosts have a multiple of them; "
            f"did you mean '{family}x{max(1, devices // GPUS_PER_HOST * GPUS_PER_HOST)}'?"
        )
    return Target(name, CARDS[family], devices // local, local)


def _slice(name: str, family: str, number: str | None) -> Target:
    """Returns a slice of a TPU; without a number the smallest one."""
    slices = SLICES[family]
    size = int(number or min(slices))
    if size not in slices:
        names = [f"{family}-{size}" for size in slices]
        raise ConfigError(f"target {name!r} is not a slice of {CARDS[family].title}; slices: {', '.join(names)}")
    shape = slices[size]
    chips = 1
    for side in shape.split("x"):
        chips *= int(side)
    local = min(chips, 4)
    if slices is _FLAT and chips == 8:
        local = 8  # one host of 8 chips
    return Target(name, CARDS[family], chips // local, local, shape)


def devices(target: Target) -> list[Any]:
    """Returns jax's descriptions of the target's devices."""
    from jax.experimental import topologies

    if target.card.platform == "cuda":
        description = topologies.get_topology_desc(
            platform="cuda",
            topology_name=target.name,
            topology=f"1x{target.hosts}x{target.local}",
            target_config=target.card.description,
        )
        return list(description.devices)
    settings: dict[str, Any] = {}
    if target.card.title == "TPU v4":
        settings["chip_config_name"] = "megacore"  # both cores of a chip as one device, as on the machines
    if target.local == 8:
        settings["chips_per_host_bounds"] = (2, 4, 1)
    family = target.name.partition("-")[0]
    description = topologies.get_topology_desc(platform="tpu", topology_name=f"{family}:{target.shape}", **settings)
    return list(description.devices)
