"""Trains a Diffusion Policy, with the same train step, loop and checkpoints as every other model here."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rsjax.artifact import make_once
from rsjax.config import LoopConfig, content_key
from rsjax.data.loader import Loader, batches
from rsjax.errors import UserError
from rsjax.evaluation.results import fingerprint
from rsjax.tools.policies.config import PolicyConfig
from rsjax.tools.policies.demos import Demos
from rsjax.tools.policies.diffusion_policy import DiffusionPolicy, Range, Windows
from rsjax.tools.policies.policy import FILE, Policy, load_policy
from rsjax.training.loop import fit

OTHERS = "holds a policy of other settings or data; choose another directory or delete it"


def train_policy(
    config: PolicyConfig,
    demos: Demos,
    directory: Path,
    *,
    name: str = "policy",
    seed: int = 0,
    stops: Sequence[int] = (),
    start: Policy | None = None,
) -> Policy:
    """Trains a policy on demonstrations, resuming where an earlier call was interrupted.

    Args:
        config: the policy's settings; ``config.train.steps`` is the length of this training. Plans are rounded up to
            whole frames (:meth:`PolicyConfig.fitted`).
        demos: the demonstrations to learn from.
        directory: the directory of checkpoints, logs and, in the end, the policy itself.
        name: for the progress line.
        seed: of the parameters, the order of the data and all draws.
        stops: steps after which the current policy is saved too, in ``directory/at-STEP``.
        start: a policy to continue from, with its range of controls.

    Raises:
        UserError: the directory holds a training on other data, with other settings, or with other stops.
        FileError: another process trains in the directory.
    """
    config = config.fitted(demos.controls)
    model = DiffusionPolicy(config, demos.image_size, demos.controls, demos.width)
    loop = replace(config.train, seed=seed)
    span = demos.range
    before = ""
    if start:
        span = start.range
        before = start.key
    data = fingerprint(([(each["rgb"], each["actions"]) for each in demos.records],))
    key = content_key(replace(config, train=loop), demos.controls, str(span), before, data)
    finished = (directory / FILE).exists()
    with make_once(directory, key, refuse=OTHERS, again=not finished):
        places = {stop: directory / f"at-{stop}" for stop in sorted(set(stops)) if stop < loop.steps}
        missing = {stop: place for stop, place in places.items() if not (place / FILE).exists()}
        if finished:
            if missing:
                raise _other_stops(directory, min(missing))
            return load_policy(directory)
        for stop, place in (missing | {loop.steps: directory}).items():
            policy = Policy(model, _fit(model, loop, demos, span, directory, name, stop, start), span)
            policy.save(place)
    return policy


def _fit(
    model: DiffusionPolicy,
    loop: LoopConfig,
    demos: Demos,
    span: Range,
    directory: Path,
    name: str,
    stop: int,
    start: Policy | None,
) -> Any:
    def loader(state: dict[str, Any] | None) -> Loader:
        return batches(demos, Windows(model, span), loop.batch_size, loop.seed, state=state)

    begin: Callable[[Any], Any] | None = (
        (lambda fresh: jax.tree.map(np.array, start.params)) if start else None
    )  # a copy, because training steps donate their parameters
    per_step = ("samples", loop.batch_size)
    options: dict[str, Any] = {"name": name, "start": begin, "stop_at": stop, "per_step": per_step}
    state = fit(model, loop, loader, directory, **options)
    if stop < loop.steps and state.step > stop:  # an earlier call with other stops trained past this one
        raise _other_stops(directory, stop)
    return state.weights


def _other_stops(directory: Path, stop: int) -> UserError:
    return UserError(
        f"{directory}: this training is beyond step {stop}, where it did not keep the policy: it kept it at other "
        f"steps; choose another --out, or ask for those"
    )
