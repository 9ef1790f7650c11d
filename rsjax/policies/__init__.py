"""Robot policies and a world model: environments to act in, judges of success, a planner.

Importing this package registers the environments with Gymnasium::

    import gymnasium, rsjax.policies

    gymnasium.make("rsjax/Lift-v0")
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rsjax.policies.simulator import LiftEnv

__all__ = ["LiftEnv", "register"]

_WHERE = {"LiftEnv": "simulator"}
_ENVIRONMENTS = {"rsjax/Lift-v0": "rsjax.policies.simulator:LiftEnv"}


def register() -> None:
    """Registers the environments with Gymnasium, unless they are. Their modules are imported when one is made."""
    import gymnasium

    for name, entry in _ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(name, entry_point=entry)


def __getattr__(name: str) -> Any:
    """Imports a public class, and with it jax or the simulator, when it is first used."""
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"rsjax.policies.{_WHERE[name]}"), name)


register()
