"""Clusters of accelerators, named as users name them: ``h100x8``, ``v5e-16``."""

import re
from dataclasses import dataclass
from typing import Any

from rsjax.config import ConfigError
from rsjax.errors import did_you_mean
from rsjax.tools.compile.cards import CARDS, Card

GPUS_PER_HOST = 8


@dataclass(frozen=True)
class Target:
    """A cluster: ``hosts`` machines with ``local`` devices each."""

    name: str
    card: Card
    hosts: int
    local: int
    topology: str

    @property
    def devices(self) -> int:
        """The number of devices."""
        return self.hosts * self.local


def find(name: str) -> Target:
    """Returns the cluster of this name.

    Raises:
        ConfigError: there is none.
    """
    parts = re.fullmatch(r"(\w+?)(?:x(\d+))?", name)
    card = CARDS.get(parts[1]) if parts else None
    if parts is None or card is None:
        raise ConfigError(f"target {name!r} is not known{did_you_mean(name, CARDS)}; targets: {', '.join(CARDS)}")
    devices = int(parts[2] or 1)
    local = min(devices, GPUS_PER_HOST)
    if devices % local or not devices:
        raise ConfigError(f"target {name!r}: hosts have {GPUS_PER_HOST} cards; make it a multiple of them")
    return Target(name, card, devices // local, local, f"1x{devices // local}x{local}")


def devices(target: Target) -> list[Any]:
    """Returns jax's descriptions of the target's devices."""
    from jax.experimental import topologies

    description = topologies.get_topology_desc(
        platform=target.card.platform,
        topology_name=target.name,
        topology=target.topology,
        target_config=target.card.gpu,
    )
    return list(description.devices)
