from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rsjax.config import LoopConfig
from rsjax.training.sharding import Sharding
from tests.training.toy import Regression, train


def test_training_begins_with_the_start_and_resumes_without_it(tmp_path: Path) -> None:
    loop = LoopConfig(steps=2, batch_size=2, ema=0.5, log_every=2, checkpoint_every=2)
    sevens = lambda fresh: jax.tree.map(lambda x: jnp.full_like(x, 7.0), fresh)  # noqa: E731
    still = replace(loop, steps=0, start_from="somewhere")
    state = train(still, tmp_path / "still", start=sevens)
    assert all(np.all(x == 7.0) for x in jax.tree.leaves((state.params, state.weights)))

    def never(fresh: Any) -> Any:
        raise AssertionError("there was a checkpoint")

    stopped = train(loop, tmp_path / "run", start=sevens, stop_at=1)
    assert all(x.min() > 6.0 and x.max() < 8.0 for x in jax.tree.leaves(stopped.params))
    assert train(loop, tmp_path / "run", start=never).step == 2


def test_shapes_that_a_start_leaves_stand_for_fresh_parameters() -> None:
    model = Regression()
    loop = LoopConfig(steps=2, batch_size=2)
    sharding = Sharding.create(loop)
    fresh = jax.tree.map(np.asarray, sharding.init(model, loop).params)
    for name in fresh:
        sevens = {other: np.full(x.shape, 7.0, np.float32) for other, x in fresh.items() if other != name}
        made = sharding.init(model, loop, lambda shapes: shapes | sevens).params  # noqa: B023
        jax.tree.map(np.testing.assert_array_equal, made, {name: fresh[name]} | sevens)
