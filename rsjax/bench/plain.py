"""Which models the baselines can be: those of the public Genie as it was published. Needs no torch."""

from rsjax.config import ConfigError, ModelConfig

ADDED = ("temporal_norm", "final_norm", "qk_norm", "mup")  # options that are off there


def check_plain(model: ModelConfig) -> None:
    """Raises :class:`ConfigError` where the model has something that the baseline's code has not."""
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
