from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from orbax.checkpoint.checkpoint_managers import PreservationContext

from rsjax.training.checkpoint import Checkpoints, retention

STEP = st.integers(0, 30)


@given(
    steps=st.sets(STEP),
    keep_last=st.integers(1, 4),
    keep_every=st.integers(0, 5),
    metrics=st.none() | st.dictionaries(STEP, st.sampled_from([-1.0, 0.0, 2.5])),
)
def test_kept_are_the_newest_the_multiples_and_the_best(
    steps: set[int], keep_last: int, keep_every: int, metrics: dict[int, float] | None
) -> None:
    infos: list[Any] = [SimpleNamespace(step=step, metrics=None) for step in sorted(steps)]
    policy = retention(keep_last, keep_every, metrics)
    kept = dict(zip(sorted(steps), policy.should_preserve(infos, context=PreservationContext()), strict=True))
    judged = {step: metric for step, metric in (metrics or {}).items() if step in steps}
    for step in steps:
        newest = sum(other > step for other in steps) < keep_last
        multiple = keep_every > 0 and step % keep_every == 0
        best = step in judged and all((judged[step], step) <= (metric, s) for s, metric in judged.items())
        assert kept[step] == (newest or multiple or best)


def state(step: int) -> dict[str, Any]:
    return {"w": jnp.full(3, float(step))}


def test_the_best_is_kept_also_after_a_restart(tmp_path: Path) -> None:
    expected = {1: [1], 2: [2], 3: [2, 3], 4: [2, 4], 5: [2, 4, 5], 6: [4, 6]}
    metrics = {1: 0.7, 2: 0.5, 3: None, 4: float("nan"), 5: 0.6, 6: 0.1}
    for step in expected:
        checkpoints = Checkpoints(tmp_path, keep_last=1, keep_every=4, keep_best=True)
        checkpoints.save(step, state(step), {}, metrics[step])
        assert checkpoints.steps() == expected[step]
        assert checkpoints.latest() == step
        checkpoints.close()
        assert sorted(int(path.name) for path in tmp_path.iterdir()) == expected[step]


def test_a_saved_step_is_not_overwritten(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, state(1), {"next": 1})
    checkpoints.save(1, state(2), {"next": 2})
    got, data = checkpoints.restore(state(0))
    checkpoints.close()
    assert data == {"next": 1}
    np.testing.assert_array_equal(got["w"], state(1)["w"])
