"""Starts the server of a run and prints its address."""

import os
import secrets
import socket
import sys
import threading
import webbrowser
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import uvicorn

from rsjax.clip import Video
from rsjax.config.fields import require, require_range
from rsjax.errors import UserError
from rsjax.progress import note
from rsjax.tools.play.connections import bounded, most_connections
from rsjax.tools.play.engine import Engine, warm_up
from rsjax.tools.play.guard import Guard, is_loopback
from rsjax.tools.play.hub import Hub
from rsjax.tools.play.messages import UPLOAD_BYTES, Refused
from rsjax.tools.play.play_run import PlayRun
from rsjax.tools.play.server import make_app
from rsjax.tools.play.session import first_settings
from rsjax.tools.policies.policy import check_fits, load_policy
from rsjax.tools.policies.run_data import RunData


@dataclass(frozen=True)
class ServeSettings:
    """The settings of the server.

    Attributes:
        host: the address to listen at.
        port: the port; 0: a free one.
        sessions: viewers at a time.
        idle_minutes: minutes without a message or a new frame after which a session is freed.
        lanes: frames that one pass generates.
        browser: whether to open the address in a browser.
    """

    host: str = "127.0.0.1"
    port: int = 8642
    sessions: int = 8
    idle_minutes: float = 10.0
    lanes: int = 1
    browser: bool = True

    def __post_init__(self) -> None:
        require_range(self, "play", 1, 256, "sessions", "lanes")
        require(0 <= self.port < 2**16, f"--port is {self.port}; it is from 0 to 65535")
        require(0 < self.idle_minutes <= 1440, f"--idle-minutes is {self.idle_minutes}; it is above 0, to 1440")


def serve(data: RunData, policy: Path | None, split: str, out: Path, settings: ServeSettings) -> None:
    """Serves a run until Ctrl-C.

    Raises:
        UserError: the run is missing or unfinished, cannot generate frame by frame, or the address is taken.
    """
    if data.moved is not None:
        data.clips  # noqa: B018 - a store that was named has to be there; a run's own may be missing
    run = PlayRun(data, split, load_policy(policy) if policy else None, out)
    engine = Engine(run.trained, settings.lanes)
    if run.policy is not None:
        check_fits(run.policy.sizes, data.config.clips, "--policy")
    listener = listen(settings.host, settings.port)
    guard = Guard("" if is_loopback(settings.host) else secrets.token_urlsafe(16))
    if run.missing:
        note(f"no clips to begin with ({run.missing}); only uploaded pictures")
    prepare(run, engine)
    hub = Hub(run, engine, settings.sessions, 60 * settings.idle_minutes)
    address = _address(listener, settings.host, guard)
    print(f"{address}  (Ctrl-C ends it)", flush=True)
    if settings.browser and has_display():
        threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
    config = uvicorn.Config(
        make_app(hub, guard),
        log_level="warning",
        access_log=False,
        server_header=False,
        ws_max_size=UPLOAD_BYTES + 1024,
        ws_per_message_deflate=False,
        http=bounded(most_connections(settings.sessions)),
        timeout_graceful_shutdown=2,
    )
    with suppress(KeyboardInterrupt):
        uvicorn.Server(config).run(sockets=[listener])
    engine.close()


def listen(host: str, port: int) -> socket.socket:
    """Returns a socket that listens.

    Raises:
        UserError: the address is taken, or is not an address of this machine.
    """
    try:
        family, _, _, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(where[:2], family=family)
    except UnicodeError as error:  # too long, or of characters that no name can have
        raise UserError(f"--host {host!r:.80}: is not a name or address of a machine") from error
    except OSError as error:
        raise UserError(
            f"--host {host} --port {port}: {error.strerror or error}; --port 0 takes a free port"
        ) from error


def prepare(run: PlayRun, engine: Engine) -> None:
    """Compiles the programs for the first frame, so that nobody waits for them later, and prints a frame's time."""
    note("compiling (seconds, or minutes for a large model the first time) …")
    size = run.data.config.clips.image_size
    first = Video(np.full((1, 1, size, size, 3), 128, np.uint8))
    with suppress(Refused):
        first = run.first(run.clip(0))
    decoding = first_settings(run.data.config).decoding(0, 0)
    seconds = warm_up(engine, first, run.controls.width, decoding)
    note(f"a frame takes {1000 * seconds:.0f} ms")


def _address(listener: socket.socket, host: str, guard: Guard) -> str:
    if host in ("0.0.0.0", "::"):
        name = socket.gethostname()
    else:
        name = host
    if ":" in name:
        name = f"[{name}]"
    if guard.token:
        token = f"?token={guard.token}"
    else:
        token = ""
    return f"http://{name}:{listener.getsockname()[1]}/{token}"


def has_display() -> bool:
    """Returns whether a browser can open outside this terminal."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
