"""The command: what it refuses before it serves, and that it serves and stops."""

import socket
from contextlib import suppress

import pytest

from rsjax.config import ConfigError, Departures
from rsjax.errors import UserError
from rsjax.tools.play.guard import Guard
from rsjax.tools.play.serve import ServeSettings, _address, listen
from rsjax.tools.play.session import first_settings, settings_limits
from tests.tools.pipeline import toy


def test_a_port_that_is_taken_is_named() -> None:
    with listen("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match=f"--port {port}: .*--port 0 takes a free port"):
            listen("127.0.0.1", port)
        assert _address(taken, "127.0.0.1", Guard("")) == f"http://127.0.0.1:{port}/"
        assert _address(taken, "::1", Guard("abc")) == f"http://[::1]:{port}/?token=abc"
        assert _address(taken, "0.0.0.0", Guard("abc")) == f"http://{socket.gethostname()}:{port}/?token=abc"


@pytest.mark.parametrize("host", ["x" * 300, "\ud800", "a..b", ""])
def test_a_host_that_is_none_is_one_line(host: str) -> None:
    with suppress(UserError), listen(host, 0):  # "" may mean every address
        assert host == ""


@pytest.mark.parametrize("wrong", [{"sessions": 0}, {"lanes": 0}, {"port": 2**16}, {"idle_minutes": 0.0}])
def test_impossible_settings_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ConfigError) as refused:
        ServeSettings(**wrong)  # type: ignore[arg-type]
    (name,) = wrong
    assert f"{name} is" in str(refused.value).replace("-", "_")


def test_settings_are_the_runs_and_limits_follow_from_it() -> None:
    config = toy.config()
    assert first_settings(config).describe() == {"temperature": 0.0, "steps": 2, "guidance": 1.0, "top_k": 0}
    assert settings_limits(config)["guidance"] == [1.0, 1.0]
    assert settings_limits(toy.with_model(config, departures=Departures(action_dropout=0.1)))["guidance"] == [0.0, 8.0]
