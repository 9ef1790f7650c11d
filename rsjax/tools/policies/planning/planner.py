"""Model-predictive control: searches for the action sequence with the lowest energy.

The planner knows the world only through the energy, a function ``(frames, candidate actions) → energies``.
``energies.py`` makes one from a world model and a goal; a simulator or any other predictor serves too.

Axes: N candidates, H steps of the horizon, A action dimensions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from jaxtyping import Float

from rsjax.config import ConfigError
from rsjax.config.fields import require, require_range
from rsjax.errors import UserError

# From the planner's input (any type) and N candidates (N, H, A) to energies (N,); lower is better, inf excludes one.
Energy: TypeAlias = Callable[[Any, Float[np.ndarray, "N H A"]], Float[np.ndarray, " N"]]

Propose: TypeAlias = Callable[[Any], Float[np.ndarray, "N H A"]]


@dataclass(frozen=True)
class PlannerConfig:
    """The settings of a planner's search.

    In each round it draws candidates around a mean, and moves the mean towards the good candidates.

    Attributes:
        method: "cem": the new mean and deviation are those of the ``elites`` best candidates (Rubinstein's
            cross-entropy method); "mppi": the new mean is that of all candidates, weighted by exp(-energy/λ), and the
            deviation stays the same (Williams et al. 2017).
        horizon: steps of a candidate; a task that takes longer looks the same under all of them.
        candidates: candidates in each round; they include the mean itself and the best candidate so far.
        rounds: rounds of a decision.
        elites: for "cem".
        temperature: λ for "mppi", in standard deviations of the candidates' finite energies.
        spread: standard deviation of the first candidates, as a share of the actions' scale.
        memory: correlation of a candidate's noise from one step to the next, so that arms do not tremble.
        hold: controls in an action; the noise is the same for all of them.
        margin: how much lower than that of the mean it began with an energy must be, as a share, for a search to leave
            this mean. While the energy is nearly the same for all candidates, the planner then does as it began.
        seed: seed of the draws.
    """

    method: Literal["cem", "mppi"] = "cem"
    horizon: int = 12
    candidates: int = 32
    rounds: int = 3
    elites: int = 6
    temperature: float = 0.5
    spread: float = 0.6
    memory: float = 0.6
    hold: int = 1
    margin: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        require_range(self, "planner", 1, 2**31, "horizon", "rounds", "hold")
        require_range(self, "planner", 2, 2**31, "candidates")
        require_range(self, "planner", 0, 0.999, "memory", "margin")
        require_range(self, "planner", 0, 2**31, "seed")
        require_range(self, "planner", 1, self.candidates, "elites")
        for name in ("temperature", "spread"):
            require(getattr(self, name) > 0, f"planner.{name} is {getattr(self, name)}; it must be above 0")
        if self.method not in ("cem", "mppi"):
            raise ConfigError(f"planner.method is {self.method!r}; it is cem or mppi")


@dataclass(frozen=True)
class PlannedActions:
    """The result of a search.

    Attributes:
        actions: the best candidate of all rounds, or the mean that the search began with.
        energy: its energy.
        best: the lowest energy so far after each round.
    """

    actions: Float[np.ndarray, "H A"]
    energy: float
    best: Float[np.ndarray, " rounds"]


def search(
    energy: Energy,
    frames: Any,
    mean: Float[np.ndarray, "H A"],
    low: Float[np.ndarray, " A"],
    high: Float[np.ndarray, " A"],
    scale: Float[np.ndarray, " A"],
    config: PlannerConfig,
    rng: np.random.Generator,
    proposals: Float[np.ndarray, "N H A"] | None = None,
) -> PlannedActions:
    """Searches for the action sequence of least energy.

    Args:
        energy: gives the candidates' energies; it is called ``config.rounds`` times.
        frames: the first argument of ``energy``, such as the frames so far.
        mean: where the search begins.
        low: least actions; candidates are clipped to [low, high].
        high: greatest actions.
        scale: standard deviation of usual actions, which is that of candidates for a ``config.spread`` of 1.
        proposals: further candidates of the first round, in place of drawn ones; as many of them as there is room for.

    Raises:
        UserError: the energies have the wrong shape, or one is NaN or -inf.
    """
    deviation = np.broadcast_to(config.spread * scale, mean.shape)
    start = mean
    best = mean
    lowest = np.inf
    at_start = np.inf
    history = []
    for number in range(config.rounds):
        drawn = mean + deviation * np.tile(_noise(config, len(low) // config.hold, rng), config.hold)
        drawn[0] = mean
        drawn[1] = best
        if proposals is not None and number == 0:
            some = proposals[: len(drawn) - 2]
            drawn[2 : 2 + len(some)] = some
        drawn = np.clip(drawn, low, high)
        energies = np.asarray(energy(frames, drawn.astype(np.float32)), np.float64)
        wrong = np.isnan(energies) | (energies == -np.inf)
        if energies.shape != (len(drawn),) or wrong.any():
            raise UserError(
                f"the energy of {len(drawn)} candidates has shape {energies.shape}, {wrong.sum()} of it NaN or -inf; "
                f"expected ({len(drawn)},), numbers"
            )
        if number == 0:
            at_start = float(energies[0])
        first = int(energies.argmin())
        if energies[first] < lowest:
            best = drawn[first]
            lowest = float(energies[first])
        history.append(lowest)
        finite = np.isfinite(energies)
        if not finite.any():
            continue  # nothing to move towards
        if config.method == "cem":
            elites = drawn[np.argsort(energies, kind="stable")[: min(config.elites, finite.sum())]]
            mean = elites.mean(0)
            deviation = elites.std(0) + 0.05 * scale
        else:
            width = config.temperature * max(float(energies[finite].std()), 1e-12)
            weights = np.exp(-(energies - energies[first]) / width)
            mean = np.einsum("n,nha->ha", weights / weights.sum(), drawn)
    if lowest > (1 - config.margin) * at_start:
        best = np.clip(start, low, high)
        lowest = at_start
    return PlannedActions(best.astype(np.float32), lowest, np.array(history))


class Planner:
    """Decides one action after another; each search begins with the remaining actions of the last plan.

    Args:
        energy: see :mod:`rsjax.tools.policies.planning.planner`.
        low: least actions.
        high: greatest actions.
        config: how it searches.
        propose: returns action sequences (N, H, A) from the energy's first argument, such as a policy's rollouts. They
            are candidates of every search, which begins with the first of them.
        scale: standard deviation of usual actions; by default half of their range.

    Attributes:
        plan: the plan of the last decision; None before the first decision.

    Raises:
        ConfigError: an action's length is not a multiple of ``config.hold``.
    """

    def __init__(
        self,
        energy: Energy,
        low: Float[np.ndarray, " A"],
        high: Float[np.ndarray, " A"],
        config: PlannerConfig,
        propose: Propose | None = None,
        scale: Float[np.ndarray, " A"] | None = None,
    ) -> None:
        require(
            len(low) % config.hold == 0,
            f"planner.hold is {config.hold}; it must divide the {len(low)} numbers of an action",
        )
        self._energy = energy
        self._config = config
        self._propose = propose
        self._low = np.asarray(low)
        self._high = np.asarray(high)
        self._scale = (self._high - self._low) / 2 if scale is None else np.asarray(scale)
        self.reset()

    def reset(self) -> None:
        """Forgets the plan and resets the random draws, for another episode."""
        self.plan: PlannedActions | None = None
        self._rng = np.random.default_rng(self._config.seed)

    def __call__(self, frames: Any) -> Float[np.ndarray, " A"]:
        """Returns the first action of a new plan.

        Args:
            frames: the first argument of the energy.
        """
        horizon = self._config.horizon
        mean = np.tile((self._low + self._high) / 2, (horizon, 1))
        if self.plan is not None:
            mean = np.concatenate([self.plan.actions[1:], self.plan.actions[-1:]])
        proposals = None
        if self._propose is not None:
            proposed = self._propose(frames)
            rows = np.minimum(np.arange(horizon), proposed.shape[1] - 1)  # the last action goes on
            proposals = np.concatenate([mean[None], proposed[:, rows]])
            mean = proposals[1]
        limits = (self._low, self._high, self._scale)
        self.plan = search(self._energy, frames, mean, *limits, self._config, self._rng, proposals)
        return self.plan.actions[0]


def _noise(config: PlannerConfig, width: int, rng: np.random.Generator) -> Float[np.ndarray, "N H A"]:
    """Returns normal noise of unit variance in which each step is correlated with the step before."""
    noise = rng.standard_normal((config.candidates, config.horizon, width))
    for step in range(1, config.horizon):
        fresh = np.sqrt(1 - config.memory**2) * noise[:, step]
        noise[:, step] = config.memory * noise[:, step - 1] + fresh
    return noise
