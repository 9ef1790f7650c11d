"""A trained Diffusion Policy, which acts in many episodes at once and is saved in a directory.

Axes: B episodes, O observed frames, S×S pixels, H controls of a plan, D numbers of a control, A = k·D of an action.
"""

from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.config import ClipShape, ConfigError, LoopConfig, content_key, from_dict, to_dict
from rsjax.errors import UserError
from rsjax.evaluation.results import fingerprint
from rsjax.files import disk_guard, read_json, write_json
from rsjax.tools.policies.config import PolicyConfig
from rsjax.tools.policies.diffusion_policy import DiffusionPolicy, Range
from rsjax.tools.policies.worlds.world import Observation
from rsjax.trainable import Params
from rsjax.training.checkpoint import load_weights, save_weights

FILE = "policy.json"
WEIGHTS = "weights"


@dataclass(frozen=True)
class Policy:
    """A policy with its parameters and the range of its controls."""

    model: DiffusionPolicy
    params: Params
    range: Range

    @property
    def action_dim(self) -> int:
        """A, the numbers of a clip's action."""
        return self.model.controls * self.model.width

    @property
    def sizes(self) -> tuple[int, int]:
        """Pixels of a frame, and the numbers of an action."""
        return self.model.image_size, self.action_dim

    @cached_property
    def key(self) -> str:
        """A hash of all that actions depend on: weights, range and settings except those of training."""
        model = without_training(self.model)
        return content_key("policy", str(model), str(self.range), fingerprint((self.params,)))

    def actor(self, seed: int = 0) -> "Actor":
        """Returns an actor for new episodes; the seed determines its draws."""
        return Actor(self, seed)

    @property
    def executed_frames(self) -> int:
        """Frames after which the policy makes a new plan."""
        return self.model.config.execute // self.model.controls

    def plans(self, frames: UInt8[np.ndarray, "B T S S 3"], seed: int) -> Float32[np.ndarray, "B F A"]:
        """Returns a plan for the frames that follow each video, with its own draws: an action for each frame.

        Args:
            frames: those so far; the first is repeated if the policy observes more.
        """
        model = self.model
        length = frames.shape[1]
        observed = np.maximum(np.arange(length - model.config.observations, length), 0)
        plan = _plan(without_training(model), self.params, frames[:, observed], jax.random.key(seed))
        return self.range.unscale(np.asarray(plan)).reshape(len(frames), -1, self.action_dim)

    def save(self, directory: Path) -> None:
        """Writes what :func:`load_policy` reads; ``policy.json`` comes last, so a policy that has one is complete."""
        model = self.model
        values: dict[str, Any] = {"image_size": model.image_size, "controls": model.controls, "width": model.width}
        values |= {"config": to_dict(model.config), "range": to_dict(self.range)}
        with disk_guard(directory):
            directory.mkdir(parents=True, exist_ok=True)
        save_weights(directory / WEIGHTS, self.params)
        write_json(directory / FILE, values, sealed=True)


def load_policy(directory: Path) -> Policy:
    """Reads a policy.

    Raises:
        UserError: the policy is missing, damaged or of another version.
    """
    path = directory / FILE
    if not path.exists():
        raise UserError(f"{path}: missing, so {directory} holds no policy; rsjax policy_learning trains some")
    try:
        values = read_json(path, cure="train the policy again")
        config = from_dict(PolicyConfig, values["config"])
        span = from_dict(Range, values["range"])
        model = DiffusionPolicy(config, *(int(values[name]) for name in ("image_size", "controls", "width")))
    except (ConfigError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path}: no policy of this version of rsjax ({error}); train it again") from error
    return Policy(model, load_weights(directory / WEIGHTS, jax.eval_shape(model.init, jax.random.key(0))), span)


class Actor:
    """Acts in B episodes that began together: it takes their observations and returns an action for each.

    It makes a new plan after executing as many controls of the last plan as the settings say.
    """

    def __init__(self, policy: Policy, seed: int) -> None:
        self._model = without_training(policy.model)
        self._policy = policy
        self._key = jax.random.key(seed)
        self._seen: list[np.ndarray] = []
        self._plan: np.ndarray | None = None
        self._done = 0  # frames so far

    def __call__(self, observation: Observation) -> Float32[np.ndarray, "B A"]:
        """Returns the actions to take at these frames.

        Args:
            observation: "rgb", uint8 (B, S, S, 3); the policy reads nothing else.

        Raises:
            UserError: the frames are not of the policy's size.
        """
        model = self._model
        size = model.image_size
        frames = observation["rgb"]
        if np.shape(frames)[1:] != (size, size, 3):
            raise UserError(
                f"the policy sees frames (B, {size}, {size}, 3), not {np.shape(frames)}; it is another run's"
            )
        observed = model.config.observations
        self._seen = [*(self._seen or [frames] * (observed - 1)), frames][-observed:]
        place = self._done % self._policy.executed_frames
        if place == 0:
            key = jax.random.fold_in(self._key, self._done)
            plan = _plan(model, self._policy.params, np.stack(self._seen, 1), key)
            self._plan = self._policy.range.unscale(np.asarray(plan))
        self._done += 1
        assert self._plan is not None
        controls = self._plan[:, place * model.controls : (place + 1) * model.controls]
        return controls.reshape(len(frames), -1)


def without_training(model: DiffusionPolicy) -> DiffusionPolicy:
    """Returns the model without training settings, so that policies of different trainings share one program."""
    return replace(model, config=replace(model.config, train=LoopConfig()))


@partial(jax.jit, static_argnums=0)  # one program for all policies of one size
def _plan(model: DiffusionPolicy, params: Params, frames: Any, key: Any) -> Any:
    return model.plan(params, frames, key)


def check_fits(sizes: tuple[int, int], clips: ClipShape, name: str) -> None:
    """Checks that a policy's or demonstrations' frames and actions are of the sizes of a run's clips.

    Args:
        sizes: pixels of a frame, and numbers of an action.
        name: of the policy or the demonstrations.

    Raises:
        UserError: they are not.
    """
    wanted = (clips.image_size, clips.action_dim)
    if sizes != wanted:
        raise UserError(
            f"{name}: frames of {sizes[0]} pixels and actions of {sizes[1]} numbers; the run's clips have {wanted[0]} "
            f"and {wanted[1]}"
        )
