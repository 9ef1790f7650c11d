from collections.abc import Iterator

import pytest

from rsjax.sim.gl import GLError, choose_gl
from rsjax.sim.lift import LiftSim


@pytest.fixture(scope="session")
def gl() -> str:
    """Skips a test that renders where nothing can."""
    try:
        return choose_gl()
    except GLError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def sim(gl: str) -> Iterator[LiftSim]:
    with LiftSim(image_size=64) as sim:
        yield sim
