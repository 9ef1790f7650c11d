"""Settings for decoding a session's frames, and their limits."""

from dataclasses import asdict, dataclass, replace
from typing import Any

from rsjax.config import Config
from rsjax.models.branch_states import Decoding
from rsjax.tools.play.errors import Refused
from rsjax.tools.play.messages import number, whole

MOST_STEPS = 16
MOST_TEMPERATURE = 4.0
MOST_GUIDANCE = 8.0
MOST_SEED = 2**31 - 1


@dataclass(frozen=True)
class Settings:
    """Settings that a page can change: those of :class:`rsjax.config.SampleConfig`."""

    temperature: float
    steps: int
    guidance: float
    top_k: int

    def describe(self) -> dict[str, Any]:
        """Returns the settings for a page."""
        return asdict(self)

    def decoding(self, seed: int, draw: int) -> Decoding:
        """Returns how the next frame is decoded."""
        return Decoding(self.steps, self.temperature, self.guidance, self.top_k, seed, draw)

    def changed(self, message: dict[str, Any], limits: dict[str, Any]) -> "Settings":
        """Returns the settings with the fields that a message changes.

        Raises:
            Refused: a field is outside the run's limits.
        """
        try:
            low, high = limits["guidance"]
            return replace(
                self,
                temperature=number(message, "temperature", 0, MOST_TEMPERATURE, self.temperature),
                steps=whole(message, "steps", 1, limits["steps"], self.steps),
                guidance=number(message, "guidance", low, high, self.guidance),
                top_k=whole(message, "top_k", 0, limits["top_k"], self.top_k),
            )
        except Refused as error:
            raise Refused("bad_settings", error.message) from error


def first_settings(config: Config) -> Settings:
    """Returns the run's own settings."""
    sample: Any = config.model.sample  # type: ignore[attr-defined]  # every family that branches has it
    return Settings(float(sample.temperature), sample.steps, float(sample.guidance), sample.top_k)


def settings_limits(config: Config) -> dict[str, Any]:
    """Returns the limits of a run's settings."""
    dropout = getattr(config.model, "action_dropout", 0.0)
    codes = 2 ** (config.tokenizer.code_bits // config.tokenizer.vocabularies)
    cells = config.grid**2
    return {
        "steps": max(min(MOST_STEPS, cells), first_settings(config).steps),
        "guidance": [0.0, MOST_GUIDANCE] if dropout else [1.0, 1.0],
        "top_k": codes,
    }
