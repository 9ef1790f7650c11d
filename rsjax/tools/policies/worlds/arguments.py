"""Checks of arguments that all environments take; it imports neither jax nor a simulator."""

from typing import Any

import numpy as np

from rsjax.errors import UserError

MOST_SEEDS = 2**32


def checked_count(name: str, count: object, most: int) -> int:
    """Returns a whole number from 1 to ``most``.

    Raises:
        UserError: it is not.
    """
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or not 1 <= count <= most:
        raise UserError(f"{name} is {count!r:.80}; it is a whole number from 1 to {most}")
    return int(count)


def checked_seed(seed: object) -> int | None:
    """Returns the seed of one environment.

    Raises:
        UserError: it is neither None nor a whole number from 0 to 2³² - 1.
    """
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < MOST_SEEDS:
        raise UserError(f"seed is {seed!r:.80}; it is a whole number from 0 to {MOST_SEEDS - 1}")
    return int(seed)


def check_render_mode(mode: object, metadata: dict[str, Any]) -> None:
    """Raises :class:`UserError` unless the metadata of an environment name this render mode, or it is None."""
    modes = metadata["render_modes"]
    if mode is not None and (not isinstance(mode, str) or mode not in modes):
        raise UserError(f"render_mode is {mode!r:.80}; it is {' or '.join(map(repr, modes))}, or None")
