"""Robot policies and a world model: environments to act in, judges of success, a planner.

Importing this package registers the environments with Gymnasium::

    import gymnasium, rsjax.tools.policies

    gymnasium.make("rsjax/WorldModel-v0", run="runs/tiny")
    gymnasium.make_vec("rsjax/WorldModel-v0", num_envs=64, run="runs/tiny")
    gymnasium.make("rsjax/Lift-v0")
    gymnasium.make("rsjax/RemoteWorldModel-v0", url="ws://127.0.0.1:8643")  # served by rsjax serve
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rsjax.tools.policies.worlds.environments import LiftEnv, WorldModelEnv, WorldModelVectorEnv

__all__ = ["LiftEnv", "WorldModelEnv", "WorldModelVectorEnv", "register"]

_MODULE = "rsjax.tools.policies.worlds.environments"
_ENVIRONMENTS: dict[str, dict[str, Any]] = {
    "rsjax/WorldModel-v0": {
        "entry_point": f"{_MODULE}:WorldModelEnv",
        "vector_entry_point": f"{_MODULE}:WorldModelVectorEnv",
    },
    "rsjax/Lift-v0": {"entry_point": f"{_MODULE}:LiftEnv"},
    "rsjax/RemoteWorldModel-v0": {"entry_point": "rsjax.tools.serve.client:RemoteWorldModelEnv"},
}


def register() -> None:
    """Registers the environments with Gymnasium, once. Making one imports its module."""
    import gymnasium

    for name, entries in _ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(name, **entries)


def __getattr__(name: str) -> Any:
    """Imports a public class, and with it jax or the simulator, at its first use."""
    if name not in ("LiftEnv", "WorldModelEnv", "WorldModelVectorEnv"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_MODULE), name)


register()
