"""Settings that have to stand before jax is loaded."""

import os

import pytest

# The tests compile hundreds of small programs and run each a few times: compiling is most of their time, and without
# LLVM's optimisations it takes half. How fast programs run is for benchmarks.
FLAG = "--xla_backend_optimization_level"
if FLAG not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FLAG}=0".strip()


@pytest.fixture(scope="session")
def gl() -> str:
    """Skips a test that renders where nothing can."""
    from rsjax.sim.gl import GLError, choose_gl

    try:
        return choose_gl()
    except GLError as error:
        pytest.skip(str(error))
