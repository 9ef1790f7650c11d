from collections.abc import Iterator

import pytest

from rsjax.tools.sim.lift import LiftSim


@pytest.fixture(scope="session")
def sim(gl: str) -> Iterator[LiftSim]:
    with LiftSim(image_size=64) as sim:
        yield sim
