"""The server of a world model: connections, the token, limits, and what it says of itself."""

import threading
import time
import traceback
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass
from socket import socket as Socket
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.protocol import State
from websockets.sync.server import Server, ServerConnection, serve

import rsjax
from rsjax.clip import GENERATED_MARK
from rsjax.config.fields import require, require_range
from rsjax.devices import on_cpu
from rsjax.errors import UserError, first_line
from rsjax.progress import note
from rsjax.tools.play.connections import most_connections
from rsjax.tools.play.engine import Engine, EngineClosedError
from rsjax.tools.play.guard import Guard, is_loopback
from rsjax.tools.play.play_run import PlayRun
from rsjax.tools.play.serve import listen, prepare
from rsjax.tools.play.session import first_settings
from rsjax.tools.policies.judges.judge_training import judge_of
from rsjax.tools.policies.worlds.environments import WorldModelEnv
from rsjax.tools.serve.listener import BoundedListener
from rsjax.tools.serve.session import ClientSession
from rsjax.tools.serve.shared_steps import SharedSteps
from rsjax.tools.serve.wire import WireError, pack, unpack

VERSION = 1  # of the messages
STRIKES = 20  # messages in a row that cannot be answered, after which a client is disconnected
VIDEO_BYTES = 64 * 2**20  # of a generated video; for large pictures this lowers the number of frames
SPARE_BYTES = 64 * 2**10  # of a message beside its arrays
LEAST_TOKEN = 16  # characters
OPEN_SECONDS = 10  # within which a connection has to ask for something
ACCELERATOR_LANES = 8


@dataclass(frozen=True)
class WorldServerSettings:
    """The settings of the server.

    Attributes:
        host: the address to listen at.
        port: the port; 0: a free one.
        token: a secret that clients must send; "" for none, which only the loopback address allows.
        clients: connections at a time.
        lanes: steps of different clients that one pass generates; 0: 8 on an accelerator, 1 on a CPU.
        frames: frames of an episode, or of a generated video, at most.
        idle_minutes: minutes without a message after which a client is disconnected.
    """

    host: str = "127.0.0.1"
    port: int = 8643
    token: str = ""
    clients: int = 16
    lanes: int = 0
    frames: int = 256
    idle_minutes: float = 30.0

    def __post_init__(self) -> None:
        require_range(self, "serve", 1, 256, "clients")
        require_range(self, "serve", 0, 256, "lanes")
        require(2 <= self.frames <= 4096, f"--frames is {self.frames}; it is from 2 to 4096")
        require(0 <= self.port < 2**16, f"--port is {self.port}; it is from 0 to 65535")
        require(0 < self.idle_minutes <= 1440, f"--idle-minutes is {self.idle_minutes}; it is above 0, to 1440")
        require(
            bool(self.token) or is_loopback(self.host),
            f"--host {self.host} lets other machines in, which takes a secret: "
            f"export RSJAX_TOKEN=$(openssl rand -hex 16)",
        )
        require(
            not self.token or len(self.token) >= LEAST_TOKEN,
            f"the token has {len(self.token)} characters; take at least {LEAST_TOKEN} (openssl rand -hex 16)",
        )


class WorldServer:
    """Serves a run to clients, each in a thread of its own; one engine generates the frames of all.

    Args:
        run: the run and its clips.
        settings: address and limits.

    Attributes:
        engine: generates the frames of all clients.
        metadata: the first message to each client.

    Raises:
        UserError: the run is missing or unfinished, or its model takes no actions or cannot generate frame by frame.
    """

    def __init__(self, run: PlayRun, settings: WorldServerSettings) -> None:
        trained = run.trained
        size = trained.config.clips.image_size
        self._run = run
        self._settings = settings
        self._judge = judge_of(run.data.run, "run", size)
        lanes = settings.lanes
        if lanes == 0:
            lanes = 1 if on_cpu() else ACCELERATOR_LANES
        self.engine = Engine(trained, lanes)
        decoding = first_settings(trained.config).decoding(trained.config.model.sample.seed, 0)  # type: ignore[attr-defined]
        self._decoding = decoding
        self._places = threading.Semaphore(settings.clients)
        self._frames = max(2, min(settings.frames, VIDEO_BYTES // (size * size * 7)))  # 3 bytes of RGB, 4 of depth
        self.metadata = self.describe()

    def environment(self) -> WorldModelEnv:
        """Returns an environment whose steps the engine makes, for one client."""
        data = self._run.data
        return WorldModelEnv(
            data,
            imagination=SharedSteps(self.engine, self._decoding),
            data_dir=data.data_dir,
            store=data.moved,
            split=self._run.split,
            max_steps=self._frames - 1,
            judge=self._judge,
        )

    def open(self, listener: Socket) -> Server:
        """Returns a server that takes over a listening socket; its ``serve_forever`` accepts clients."""
        config = self._run.trained.config.clips
        frame = config.image_size**2 * (3 + 8)  # its depth may come as float64
        actions = self._frames * config.action_dim * 8
        return serve(
            self.serve_client,
            sock=BoundedListener(listener, most_connections(self._settings.clients)),
            origins=[None],  # no browser: a page of another site cannot reach the server through one
            process_request=self.refusal,
            compression=None,
            open_timeout=OPEN_SECONDS,
            max_size=frame + actions + SPARE_BYTES,
            server_header=None,
        )

    def close(self) -> None:
        """Ends the engine, so that no client waits for a frame any more."""
        self.engine.close()

    def describe(self) -> dict[str, Any]:
        """Returns the first message to a client: the run, its actions, and the limits."""
        env = self.environment()
        space: Any = env.action_space
        observation: Any = env.observation_space
        facts = {
            "server": "rsjax",
            "version": VERSION,
            "rsjax": rsjax.__version__,
            "synthetic": GENERATED_MARK,
            "judge": self._judge is not None,
            "action_low": space.low,
            "action_high": space.high,
            "limits": {
                "frames": self._frames,
                "clients": self._settings.clients,
                "idle_seconds": 60 * self._settings.idle_minutes,
            },
        }
        if "depth" in observation.spaces:
            facts["depth_high"] = float(observation["depth"].high.max())
        return self._run.describe() | facts

    def refusal(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answers a request for health, and refuses a client without the token; None: the client may connect."""
        if request.path == "/healthz":
            return connection.respond(200, "OK\n")
        scheme, _, token = request.headers.get("Authorization", "").partition(" ")
        if scheme not in ("Api-Key", "Bearer"):
            token = ""
        if not Guard(self._settings.token).knows({"token": token}):
            return connection.respond(401, "this server wants its token in Authorization: Api-Key TOKEN\n")
        return None

    def serve_client(self, connection: ServerConnection) -> None:
        """Serves one client until it leaves or is disconnected."""
        if not self._places.acquire(blocking=False):
            connection.send(f"all {self._settings.clients} places are taken; try again later")
            connection.close(1013, "all places are taken")
            return

        def check_present() -> None:
            if connection.state is not State.OPEN:
                raise CancelledError("the client has left")

        try:
            connection.send(pack(self.metadata))
            self.answer_messages(connection, ClientSession(self.environment, self._frames, check_present))
        except TimeoutError:
            connection.close(1001, f"no message for {self._settings.idle_minutes:g} minutes")
        except (ConnectionClosed, CancelledError, EngineClosedError):
            pass
        finally:
            self._places.release()

    def answer_messages(self, connection: ServerConnection, session: ClientSession) -> None:
        """Answers a client's messages, one after another, until too many in a row make no sense."""
        strikes = 0
        while strikes < STRIKES:
            data = connection.recv(60 * self._settings.idle_minutes)
            began = time.monotonic()
            try:
                if isinstance(data, str):
                    raise WireError("a message is binary, a map in msgpack; this one is text")
                reply = session.answer(unpack(data))
            except UserError as error:
                strikes += 1
                connection.send(first_line(error))
                continue
            except (CancelledError, EngineClosedError):
                raise
            except Exception:
                traceback.print_exc()
                connection.send("the server failed at this message; its terminal says why")
                connection.close(1011, "the server failed")
                return
            strikes = 0
            reply["server_timing"] = {"infer_ms": 1000 * (time.monotonic() - began)}
            connection.send(pack(reply))
        connection.close(1008, f"{STRIKES} messages in a row could not be answered")


def serve_world(run: PlayRun, settings: WorldServerSettings) -> None:
    """Serves a run until Ctrl-C.

    Raises:
        UserError: the run cannot be served, or the address is taken.
    """
    listener = listen(settings.host, settings.port)
    world = WorldServer(run, settings)
    if run.missing:
        note(f"no clips to begin with ({run.missing}); a reset needs a frame of its own")
    prepare(run, world.engine)
    server = world.open(listener)
    host = settings.host
    if ":" in host:
        host = f"[{host}]"
    print(f"ws://{host}:{server.socket.getsockname()[1]}  (Ctrl-C ends it)", flush=True)
    print("next: docs/serve.md has ten lines of client code; curl http://…/healthz says whether it runs", flush=True)
    with suppress(KeyboardInterrupt):
        server.serve_forever()
    world.close()
    server.shutdown()
