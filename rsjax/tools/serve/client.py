"""The client of a served world model, and a Gymnasium environment on top of it. Needs neither jax nor the model.

Axes: T frames, S×S pixels, A action dimensions.
"""

import os
from contextlib import ExitStack
from typing import Any, Self

import gymnasium
import numpy as np
from gymnasium import spaces
from jaxtyping import Float
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.sync.client import connect

from rsjax.errors import UserError, first_line
from rsjax.tools.policies.worlds.arguments import check_render_mode, checked_count, checked_seed
from rsjax.tools.serve.wire import pack, unpack

URL = "ws://127.0.0.1:8643"


class ServerError(UserError):
    """The server is not there, refuses the client, or cannot do what a message asks for; the text says which."""


class WorldClient:
    """A connection to a world model that ``rsjax serve`` serves: one episode, and any number of whole videos.

    Args:
        url: the address that the server printed.
        token: the server's secret; default: the environment variable RSJAX_TOKEN.
        timeout: seconds to wait for an answer; the first step of a large model compiles for minutes.

    Attributes:
        metadata: what the server says of its model, actions and limits.
        socket: the WebSocket.

    Raises:
        ServerError: there is no server, or it refuses the client.
    """

    def __init__(self, url: str = URL, token: str | None = None, timeout: float = 600.0) -> None:
        if not isinstance(url, str):
            raise ServerError(f"url is {url!r:.80}; give the address that the server printed, such as {URL}")
        if token is not None and not isinstance(token, str):
            raise ServerError(f"token is {type(token).__name__}; it is the text of the server's RSJAX_TOKEN")
        secret = token or os.environ.get("RSJAX_TOKEN", "")
        if not (secret.isascii() and secret.isprintable()):
            raise ServerError("the token has other characters than printable ASCII; give the server's RSJAX_TOKEN")
        headers = {}
        if secret:
            headers["Authorization"] = f"Api-Key {secret}"
        self._timeout = timeout
        self._connection = ExitStack()
        try:
            socket = connect(url, compression=None, max_size=None, additional_headers=headers)
            self.socket = self._connection.enter_context(socket)
        except InvalidStatus as error:
            body = (error.response.body or b"").decode(errors="replace").strip()
            raise ServerError(f"{url}: {body or error}") from error
        except (OSError, ConnectionClosed) as error:
            raise ServerError(f"{url!r:.80}: no server answers ({error}); rsjax serve RUN starts one") from error
        except (WebSocketException, ValueError) as error:
            raise ServerError(
                f"{url!r:.80}: no server to talk to ({first_line(error)}); give one such as {URL}"
            ) from error
        try:
            self.metadata = self._receive()
        except UserError:
            self.close()
            raise

    def ask(self, endpoint: str, **fields: Any) -> dict[str, Any]:
        """Sends a message and returns the answer.

        Raises:
            ServerError: the server cannot do it, ends the connection, or answers too late, which ends it too.
        """
        try:
            self.socket.send(pack({"endpoint": endpoint} | fields))
        except ConnectionClosed as error:
            raise ServerError(f"the server ended the connection: {error}") from error
        return self._receive()

    def reset(self, **start: Any) -> dict[str, Any]:
        """Begins an episode; fields as in docs/serve.md: "seed", "clip", "rgb" with "depth", "draw"."""
        return self.ask("reset", **start)

    def step(self, action: Float[np.ndarray, " A"]) -> dict[str, Any]:
        """Generates the episode's next frame."""
        return self.ask("step", action=np.asarray(action))

    def generate(self, actions: Float[np.ndarray, "T A"], **start: Any) -> dict[str, Any]:
        """Generates a whole video of T frames, beside the episode; row t leads into frame t, row 0 is not read."""
        return self.ask("generate", actions=np.asarray(actions), **start)

    def close(self) -> None:
        """Ends the connection."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _receive(self) -> dict[str, Any]:
        try:
            answer = self.socket.recv(self._timeout)
        except TimeoutError as error:
            self.close()  # else the late answer would be taken for that to the next request
            raise ServerError(f"no answer within {self._timeout:g} seconds; connect again") from error
        except ConnectionClosed as error:
            raise ServerError(f"the server ended the connection: {error}") from error
        if isinstance(answer, str):
            raise ServerError(answer)
        return unpack(answer)


class RemoteWorldModelEnv(gymnasium.Env[Any, Any]):
    """A served world model as an environment like :class:`rsjax.tools.policies.WorldModelEnv`.

    Args:
        url: as for :class:`WorldClient`.
        token: as for :class:`WorldClient`.
        max_steps: steps after which an episode is truncated; at most the server's limit.
        render_mode: "rgb_array", or None.

    Raises:
        UserError: there is no server, it refuses the client, or an argument is not allowed.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012 - Gymnasium's own type

    def __init__(
        self, url: str = URL, token: str | None = None, max_steps: int = 30, render_mode: str | None = None
    ) -> None:
        check_render_mode(render_mode, self.metadata)
        self.client = WorldClient(url, token)
        facts = self.client.metadata
        try:
            checked_count("max_steps", max_steps, facts["limits"]["frames"] - 1)
        except UserError as error:
            self.client.close()
            raise ServerError(error) from error
        side = facts["image_size"]
        observed: dict[str, spaces.Space[Any]] = {"rgb": spaces.Box(0, 255, (side, side, 3), np.uint8)}
        if "depth_high" in facts:
            observed["depth"] = spaces.Box(0.0, facts["depth_high"], (side, side))
        self.observation_space = spaces.Dict(observed)
        self.action_space = spaces.Box(facts["action_low"], facts["action_high"])
        self.render_mode = render_mode
        self._max_steps = max_steps
        self._frame: np.ndarray | None = None
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begins an episode; arguments as for :meth:`WorldModelEnv.reset`.

        Raises:
            UserError: the server cannot begin it, or an argument is not allowed.
        """
        seed = checked_seed(seed)
        super().reset(seed=seed)
        start = {} if options is None else options
        if not isinstance(start, dict) or not all(isinstance(name, str) for name in start):
            raise UserError(f"options are {start!r:.80}; give a dict with some of rgb, depth, clip and draw")
        if seed is not None:
            start = start | {"seed": seed}
        self._steps = 0
        return self._seen(self.client.reset(**start))

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Generates the next frame; results as of :meth:`WorldModelEnv.step`.

        Raises:
            ServerError: the server refuses the action.
        """
        if self._frame is None:
            raise gymnasium.error.ResetNeeded("reset the environment before its first step")
        answer = self.client.step(action)
        self._steps += 1
        facts = (float(answer.pop("reward")), bool(answer.pop("terminated")), bool(answer.pop("truncated")))
        observation, info = self._seen(answer)
        return observation, facts[0], facts[1], facts[2] or self._steps >= self._max_steps, info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Returns the current frame; None without a render mode."""
        if self.render_mode:
            return self._frame
        return None

    def close(self) -> None:
        """Ends the connection."""
        self.client.close()

    def _seen(self, answer: dict[str, Any]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Splits an answer into the observation and the info."""
        answer.pop("server_timing")  # Gymnasium wants the same info for the same seed and action
        observation = {name: answer.pop(name) for name in self.observation_space.spaces}  # type: ignore[attr-defined]
        self._frame = observation["rgb"]
        return observation, answer
