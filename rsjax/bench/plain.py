"""Checks that the PyTorch baseline can be compared with a model, without importing torch."""

from rsjax.config import ConfigError
from rsjax.models.roboscape.architecture import Architecture

ADDED = ("temporal_norm", "final_norm", "qk_norm", "mup")  # options that the baseline lacks


def check_plain(model: Architecture) -> None:
    """Raises :class:`ConfigError` if the model has an option that the baseline lacks."""
    for name in ADDED:
        if getattr(model, name):
            raise ConfigError(
                f"model.{name} is on, and the PyTorch baseline is the plain Genie, without it; "
                f"set it to False, or leave the baseline out"
            )
    if model.positions != "learned":
        raise ConfigError(
            f"model.positions is {model.positions!r}, and the PyTorch baseline is the plain Genie, which learns them; "
            f"set it to 'learned', or leave the baseline out"
        )
