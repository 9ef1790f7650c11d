"""Short ways to write curricula in tests."""

from typing import Any

from rsjax.config import ComponentConfig, CurriculumStageConfig


def stage(
    difficulty: str = "*", epochs: float = 1.0, *, restart: bool = False, **component: Any
) -> CurriculumStageConfig:
    """A stage of one component: the clips of a difficulty, or of all."""
    return CurriculumStageConfig((ComponentConfig(difficulties=(difficulty,), **component),), epochs, restart)


def mixed(shares: dict[str, float], epochs: float = 1.0) -> CurriculumStageConfig:
    """A stage that mixes difficulties by these shares."""
    components = [ComponentConfig(difficulties=(name,), weight=weight) for name, weight in shares.items()]
    return CurriculumStageConfig(tuple(components), epochs)


PAPER = (stage("simple", 2.0), stage("difficult", 3.0))
