import jax
import jax.numpy as jnp
import numpy as np

from rsjax.model.attention import attend
from rsjax.model.frame_attention import attend_in_frames


def test_output_and_gradients_are_plain_attention_s_to_bf16_rounding() -> None:
    keys = jax.random.split(jax.random.key(0), 4)
    q, k, v, cotangent = (jax.random.normal(key, (3, 10, 2, 8)) for key in keys)  # N S h e
    found, pull = jax.vjp(jax.jit(attend_in_frames), q, k, v)
    plain, pull_plain = jax.vjp(lambda q, k, v: attend(q, k, v, None), q, k, v)
    for x, y in zip((found, *pull(cotangent)), (plain, *pull_plain(cotangent)), strict=True):
        assert x.dtype == jnp.float32 and x.shape == y.shape
        np.testing.assert_allclose(x, y, atol=0.02 * float(jnp.max(jnp.abs(y))))


def test_a_frame_attends_to_itself_alone() -> None:
    x = jax.random.normal(jax.random.key(1), (2, 5, 2, 4))
    together = attend_in_frames(x, x, x)
    alone = attend_in_frames(x[1:], x[1:], x[1:])
    np.testing.assert_array_equal(together[1:], alone)
