"""A server with a fake model, shared by the tests of a file."""

from collections.abc import Iterator

import pytest

pytest.importorskip("uvicorn", reason="uvicorn is not installed (make setup)")
pytest.importorskip("websockets", reason="websockets is not installed (make setup)")

from rsjax.tools.play.play_run import PlayRun
from tests.tools.play.client import Server, serving
from tests.tools.play.fake import Fakes, hub_of, play_run


@pytest.fixture(scope="module")
def fakes() -> Fakes:
    return Fakes()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, fakes: Fakes) -> PlayRun:
    return play_run(tmp_path_factory.mktemp("play"), fakes)


@pytest.fixture(scope="module")
def server(run: PlayRun) -> Iterator[Server]:
    with serving(hub_of(run)) as served:
        yield served
