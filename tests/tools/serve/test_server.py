"""A served world model: the frames of the local one, alone and together; limits; and messages that are wrong."""

import http.client
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import msgpack
import numpy as np
import pytest

pytest.importorskip("websockets", reason="websockets is not installed (make setup)")
from gymnasium.utils.env_checker import check_env
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.sync.server import serve
from websockets.typing import Origin

import rsjax.tools.policies  # noqa: F401 - registers
from rsjax.clip import GENERATED_MARK, Video
from rsjax.config import ConfigError, SampleConfig, StateHeadsConfig
from rsjax.data.store import Store
from rsjax.errors import UserError
from rsjax.models.branch_states import Decoding
from rsjax.models.trained import TrainedModel
from rsjax.tools.pipeline.run import Run
from rsjax.tools.play.connections import most_connections
from rsjax.tools.play.engine import Engine
from rsjax.tools.play.play_run import PlayRun
from rsjax.tools.play.serve import listen
from rsjax.tools.policies.run_data import RunData
from rsjax.tools.policies.worlds.environments import WorldModelEnv
from rsjax.tools.serve.client import RemoteWorldModelEnv, ServerError, WorldClient
from rsjax.tools.serve.listener import BoundedListener
from rsjax.tools.serve.server import STRIKES, WorldServer, WorldServerSettings
from rsjax.tools.serve.shared_steps import SharedSteps
from rsjax.tools.serve.wire import pack, unpack
from tests.tools.pipeline import toy
from tests.tools.play.fake import Fakes
from tests.waiting import wait_until

FRAMES = 9  # the window is 6 frames
ROOT = Path(__file__).parents[3]
TOKEN = "a-token-nobody-knows"


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Store:
    folder = tmp_path_factory.mktemp("serve")
    return toy.store(Run(toy.config(), folder, folder).clips)


@pytest.fixture(scope="module")
def model(clips: Store) -> TrainedModel:
    sample = SampleConfig(steps=2, temperature=1.0, unmask="greedy")
    config = toy.with_model(toy.config(), sample=sample, state_heads=StateHeadsConfig())
    return toy.trained(clips, config)


@pytest.fixture(scope="module")
def run(clips: Store, model: TrainedModel) -> PlayRun:
    data = RunData(clips.path.parent / "run", clips.path.parent)
    data.__dict__["trained"] = model
    data.__dict__["config"] = model.config
    return PlayRun(data)


@pytest.fixture(scope="module")
def local(clips: Store, model: TrainedModel) -> WorldModelEnv:
    return WorldModelEnv(model, data_dir=clips.path.parent)


@contextmanager
def serving(run: PlayRun, kind: type[WorldServer] = WorldServer, **settings: Any) -> Iterator[str]:
    """Serves a run; yields the address."""
    world = kind(run, WorldServerSettings(port=0, frames=FRAMES, **settings))
    listener = listen("127.0.0.1", 0)
    server = world.open(listener)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
    finally:
        world.close()
        server.shutdown()
        thread.join()


@pytest.fixture(scope="module")
def url(run: PlayRun) -> Iterator[str]:
    with serving(run, lanes=2, clients=20) as address:
        yield address


def actions(count: int, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 28)).astype(np.float32)


def episode(url: str, clip: int, rows: np.ndarray) -> list[dict[str, Any]]:
    with WorldClient(url) as client:
        return [client.reset(clip=clip, draw=clip), *(client.step(row) for row in rows)]


def assert_same(one: dict[str, Any], other: dict[str, Any], levels: int = 0) -> None:
    assert np.abs(one["rgb"].astype(int) - other["rgb"]).max() <= levels
    np.testing.assert_allclose(one["depth"], other["depth"], rtol=0.01 if levels else 0)


def test_served_frames_are_those_of_the_local_world(url: str, local: WorldModelEnv) -> None:
    rows = actions(FRAMES - 1)
    served = episode(url, 1, rows)
    seen, info = local.reset(options={"clip": 1, "draw": 1})
    assert_same(served[0], seen)
    for name in ("clip", "label", "height", "opening"):
        assert served[0][name] == info[name]
    for answer, row in zip(served[1:], rows, strict=True):
        seen, reward, terminated, _, info = local.step(row)
        assert_same(answer, seen, levels=1)  # one program decodes several images, the other one: float32's last bit
        assert (answer["reward"], answer["terminated"], answer["clipped"]) == (reward, terminated, info["clipped"])
        np.testing.assert_allclose([answer["height"], answer["opening"]], [info["height"], info["opening"]], rtol=1e-4)
    assert np.ptp([answer["rgb"] for answer in served], axis=0).max() > 50
    assert served[-1]["truncated"] and served[-1]["frame"] == FRAMES - 1


def test_clients_at_the_same_time_get_the_frames_that_each_gets_alone(url: str) -> None:
    rows = {1: actions(FRAMES - 1, 5), 2: actions(FRAMES - 1, 6)}
    alone = {clip: episode(url, clip, rows[clip]) for clip in rows}
    together: dict[int, list[dict[str, Any]]] = {}
    threads = [
        threading.Thread(target=lambda clip=clip: together.update({clip: episode(url, clip, rows[clip])}))
        for clip in rows
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for clip, answers in alone.items():
        for one, other in zip(answers, together[clip], strict=True):
            assert_same(one, other)


def test_steps_that_wait_together_are_one_pass() -> None:
    fakes = Fakes()
    trained: Any = SimpleNamespace(model=fakes, params={}, assets=None)
    engine = Engine(trained, lanes=2)
    clips = [SharedSteps(engine, Decoding(1)) for _ in range(3)]
    first = Video(np.zeros((1, 1, 64, 64, 3), np.uint8), np.ones((1, 1, 64, 64), np.float32))
    for number, clip in enumerate(clips):
        clip.restart(np.ones(1, bool), first, np.array([number]))
    fake = fakes.kinds[True]
    fake.gate.clear()
    threads = [threading.Thread(target=clip.step, args=(np.zeros((1, 28), np.float32),)) for clip in clips]
    threads[0].start()
    wait_until(lambda: fake.passes == [1])
    for thread in threads[1:]:
        thread.start()
    wait_until(lambda: engine.waiting == 2)
    fake.gate.set()
    for thread in threads:
        thread.join()
    engine.close()
    assert fake.passes == [1, 2]


def test_a_whole_video_is_its_steps_and_leaves_the_episode_as_it_is(url: str) -> None:
    rows = actions(5)
    with WorldClient(url) as client:
        client.reset(clip=0, draw=0)
        first = client.step(rows[1])
        video = client.generate(rows, clip=0, draw=0)
        after = [first, *(client.step(row) for row in rows[2:])]
    assert video["rgb"].shape == (5, 64, 64, 3) and video["success"].shape == (5,)
    for frame, answer in enumerate(after, 1):
        assert_same({name: video[name][frame] for name in ("rgb", "depth")}, answer)


def test_the_remote_environment_is_one_for_gymnasium(url: str, local: WorldModelEnv, clips: Store) -> None:
    env = gymnasium.make("rsjax/RemoteWorldModel-v0", url=url, max_steps=3)
    remote = env.unwrapped
    assert isinstance(remote, RemoteWorldModelEnv)
    assert remote.observation_space == local.observation_space and remote.action_space == local.action_space
    check_env(remote, skip_render_check=True)
    chosen = env.reset(seed=11)[1]["clip"]
    assert chosen == local.reset(seed=11)[1]["clip"]  # a seed chooses the same clip and draws
    assert isinstance(chosen, np.integer) and env.reset(options={"clip": chosen})[1]["clip"] == chosen
    assert remote.client.reset(seed=np.int64(11), draw=np.int32(0))["clip"] == chosen
    clip = clips.source("test")[2]
    seen, _ = env.reset(options={"rgb": clip["rgb"][0], "depth": clip["depth"][0], "draw": 5})
    assert_same(seen, local.reset(options={"clip": 2, "draw": 5})[0])
    for truncated in (False, False, True):
        seen, reward, terminated, over, info = env.step(np.zeros(28, np.float32))
        assert (over, terminated, reward) == (truncated, False, 0.0)
    assert env.observation_space.contains(seen) and info["label"] == "unjudged"
    env.close()
    with pytest.raises(ServerError) as long:
        RemoteWorldModelEnv(url, max_steps=9)
    assert "from 1 to 8" in str(long.value)


WRONG: list[tuple[dict[str, Any], str]] = [
    ({}, "endpoint is None; it is one of reset, step, generate"),
    ({"endpoint": "exec"}, "endpoint is 'exec'"),
    ({"endpoint": ["step"]}, "endpoint is ['step']"),
    ({"endpoint": "step", "actions": [0]}, "unknown field 'actions'; did you mean 'action'?"),
    ({"endpoint": "step"}, "expected floats of shape (28,)"),
    ({"endpoint": "step", "action": np.zeros(7)}, "actions have shape (7,); expected (28,)"),
    ({"endpoint": "step", "action": np.full(28, np.inf)}, "actions[0] is inf"),
    ({"endpoint": "step", "action": {"a": 1}}, "expected floats of shape (28,)"),
    ({"endpoint": "reset", "clip": 99}, "no clip 99 in the test split, which has 0 … 4"),
    ({"endpoint": "reset", "clip": "1"}, "no clip '1' in the test split, which has 0 … 4"),
    ({"endpoint": "reset", "clip": np.array([1, 2])}, "no clip array([1, 2])"),
    ({"endpoint": "reset", "draw": -1}, "the option draw is -1; it is a whole number"),
    ({"endpoint": "reset", "seed": 2**40}, "seed is 1099511627776; it is a whole number"),
    ({"endpoint": "reset", "seed": {}}, "seed is {}"),
    ({"endpoint": "reset", "rgb": np.zeros((8, 8, 3), np.uint8)}, "expected (64, 64, 3)"),
    ({"endpoint": "reset", "rgb": "x", "clip": 1}, "not with both"),
    ({"endpoint": "generate", "actions": np.zeros((1, 28))}, "T from 2 to 9"),
    ({"endpoint": "generate", "actions": np.zeros((10, 28))}, "T from 2 to 9"),
    ({"endpoint": "generate", "actions": [[1.0], [1.0, 2.0]]}, "actions"),
    ({"endpoint": "generate", "actions": np.zeros((5, 7))}, "actions have shape (5, 7); expected (5, 28)"),
    ({"endpoint": "generate", "actions": np.outer([0, 0, 0, 0, np.inf], np.ones(28))}, "actions[4, 0] is inf"),
    ({"endpoint": "generate"}, "actions"),
]


def test_each_wrong_message_gets_one_line_and_the_episode_goes_on(url: str) -> None:
    with WorldClient(url) as client:
        with pytest.raises(ServerError) as early:
            client.step(np.zeros(28))
        assert "after a reset" in str(early.value)
        client.reset(clip=0)
        for message, said in WRONG:
            client.socket.send(pack(message))
            answer = client.socket.recv()
            assert isinstance(answer, str) and said in answer and "\n" not in answer, message
            if message.get("endpoint") == "reset":
                client.reset(clip=0)  # a right message sets the count of wrong ones back
        assert client.step(np.zeros(28))["frame"] == 1
        for data in ("text", b"\xc1", msgpack.packb([1])):
            client.socket.send(data)
            assert "map in msgpack" in str(client.socket.recv())
        while client.step(np.zeros(28))["frame"] < FRAMES - 1:
            pass
        with pytest.raises(ServerError) as late:
            client.step(np.zeros(28))
        assert f"has had its {FRAMES} frames" in str(late.value)


def test_a_client_without_sense_and_a_large_message_end_the_connection(url: str) -> None:
    with connect(url) as socket:
        socket.recv()
        for _ in range(STRIKES):
            socket.send(b"\xc1")
            socket.recv()
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv()
        assert closed.value.rcvd is not None and closed.value.rcvd.code == 1008
    with connect(url, max_size=None) as socket:
        socket.recv()
        with suppress(ConnectionClosed):
            socket.send(b"\0" * 2**20)
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv()
        assert closed.value.rcvd is not None and closed.value.rcvd.code == 1009


def test_a_video_is_not_generated_on_for_a_client_that_has_left(run: PlayRun) -> None:
    left = threading.Event()
    steps: list[Any] = []

    class WaitingEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            steps.append(action)
            left.wait(60)
            return super().step(action)

    class WaitingServer(WorldServer):
        def environment(self) -> Any:
            return WaitingEnv(super().environment())

    with serving(run, WaitingServer, clients=1) as url:
        client = WorldClient(url)
        client.socket.send(pack({"endpoint": "generate", "actions": actions(FRAMES)}))
        wait_until(lambda: len(steps) == 1)
        client.close()
        left.set()
        wait_until(lambda: free(url))
    assert len(steps) == 1


def test_the_first_message_describes_model_and_limits(url: str) -> None:
    with connect(url) as socket:  # as openpi's client connects
        first = socket.recv()
    assert isinstance(first, bytes)
    facts = unpack(first)
    assert (facts["family"], facts["image_size"], facts["clips"]) == ("roboscape", 64, toy.TEST)
    assert facts["limits"] == {"frames": FRAMES, "clients": 20, "idle_seconds": 1800.0}
    assert facts["synthetic"] == GENERATED_MARK and facts["action_low"].shape == (28,)


def test_one_client_too_many_is_told_so(run: PlayRun) -> None:
    with serving(run, clients=2) as url:
        with WorldClient(url), WorldClient(url):
            with pytest.raises(ServerError) as full:
                WorldClient(url)
            assert "all 2 places are taken" in str(full.value)
        wait_until(lambda: free(url))


def free(url: str) -> bool:
    try:
        WorldClient(url).close()
    except ServerError:
        return False
    return True


def test_a_token_is_wanted_and_no_browser_is_let_in(run: PlayRun) -> None:
    with serving(run, token=TOKEN) as url:
        with pytest.raises(ServerError) as refused:
            WorldClient(url)
        assert "wants its token" in str(refused.value)
        with pytest.raises(ServerError):
            WorldClient(url, token=TOKEN[:-1])
        WorldClient(url, token=TOKEN).close()
        headers = {"Authorization": f"Api-Key {TOKEN}"}
        with (
            pytest.raises(InvalidStatus),
            connect(url, additional_headers=headers, origin=Origin("http://evil.example")),
        ):
            pass
        assert is_healthy(url)


def is_healthy(url: str) -> bool:
    connection = http.client.HTTPConnection(url.removeprefix("ws://"), timeout=20)
    with suppress(ConnectionError, http.client.HTTPException):
        connection.request("GET", "/healthz")
        answer = connection.getresponse()
        return (answer.status, answer.read()) == (200, b"OK\n")
    return False


def idle(url: str, count: int, everything: ExitStack) -> list[socket.socket]:
    host, _, port = url.removeprefix("ws://").partition(":")
    return [everything.enter_context(socket.create_connection((host, int(port)), timeout=20)) for _ in range(count)]


def is_closed(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        return connection.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


def test_connections_that_say_nothing_are_bounded_and_let_others_in_when_they_leave(run: PlayRun) -> None:
    most = most_connections(1)
    with serving(run, clients=1) as url:
        with ExitStack() as everything:
            connections = idle(url, most + 5, everything)
            wait_until(lambda: sum(map(is_closed, connections)) == 5)
        wait_until(lambda: is_healthy(url))


def test_sending_to_a_client_that_reads_nothing_ends() -> None:
    with (
        BoundedListener(listen("127.0.0.1", 0), 1, send_seconds=1) as listener,
        socket.create_connection(listener.getsockname()) as client,
        listener.accept()[0] as connection,
    ):
        rescue = threading.Timer(30, client.close)  # then sending fails otherwise
        rescue.start()
        with pytest.raises(BlockingIOError):
            connection.sendall(bytes(2**26))
        rescue.cancel()


SERVER_OF_FEW_FILES = """
import resource, socket
from websockets.sync.server import serve
from rsjax.tools.serve.listener import BoundedListener

listener = socket.create_server(("127.0.0.1", 0))
resource.setrlimit(resource.RLIMIT_NOFILE, (32, 32))
healthy = lambda connection, request: connection.respond(200, "OK\\n")
server = serve(lambda connection: None, sock=BoundedListener(listener, 1000), process_request=healthy)
print(f"ws://127.0.0.1:{server.socket.getsockname()[1]}", flush=True)
server.serve_forever()
"""


def test_a_server_without_a_free_file_descriptor_waits_for_one() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", SERVER_OF_FEW_FILES], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as server:
        assert server.stdout is not None
        url = server.stdout.readline().strip()
        with ExitStack() as everything:
            idle(url, 40, everything)
        wait_until(lambda: server.poll() is not None or is_healthy(url))
        assert server.poll() is None
        server.kill()


def test_a_client_that_says_nothing_is_disconnected(run: PlayRun) -> None:
    with serving(run, idle_minutes=0.005) as url, WorldClient(url) as client:
        with pytest.raises(ConnectionClosed) as closed:
            client.socket.recv(20)
        assert closed.value.rcvd is not None and "no message for" in closed.value.rcvd.reason


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"host": "0.0.0.0"}, "export RSJAX_TOKEN"),
        ({"host": "0.0.0.0", "token": "short"}, "the token has 5 characters"),
        ({"clients": 0}, "serve.clients"),
        ({"frames": 1}, "--frames"),
        ({"port": 2**16}, "--port"),
        ({"idle_minutes": 0.0}, "--idle-minutes"),
    ],
)
def test_settings_that_cannot_be_are_refused(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError) as error:
        WorldServerSettings(**wrong)
    assert said in str(error.value)


def test_where_nobody_serves_the_client_says_what_to_do() -> None:
    with listen("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
    with pytest.raises(UserError) as error:
        WorldClient(f"ws://127.0.0.1:{port}")
    assert "rsjax serve RUN starts one" in str(error.value)


def test_an_answer_that_comes_too_late_is_not_taken_for_the_next() -> None:
    asked = threading.Event()

    def answer(socket: Any) -> None:
        socket.send(pack({}))
        for number, _ in enumerate(socket):
            asked.wait(60)
            socket.send(pack({"frame": number}))

    with serve(answer, "127.0.0.1", 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        client = WorldClient(f"ws://127.0.0.1:{server.socket.getsockname()[1]}", timeout=0.05)
        with pytest.raises(ServerError) as late:
            client.step(np.zeros(28))
        assert "no answer within 0.05 seconds; connect again" in str(late.value)
        asked.set()
        with pytest.raises(ServerError):
            client.step(np.zeros(28))
        server.shutdown()


def test_junk_for_the_remote_environment_is_refused_in_one_line(url: str) -> None:
    addresses: tuple[Any, ...] = ("", None, 5, "http://a", "x" * 5000, "ws://" + "x" * 5000, "ws://[::1")
    for address in addresses:
        with pytest.raises(ServerError) as none:
            RemoteWorldModelEnv(address)
        assert "such as ws://127.0.0.1:8643" in str(none.value) and len(str(none.value)) < 400
    junk: tuple[dict[str, Any], ...] = (
        {"token": "a\nb"},
        {"token": np.zeros(0)},
        {"render_mode": 5},
        {"max_steps": "x"},
    )
    for arguments in junk:
        with pytest.raises(UserError) as error:
            RemoteWorldModelEnv(url, **arguments)
        assert next(iter(arguments)) in str(error.value)
    env = RemoteWorldModelEnv(url, max_steps=2)
    for wrong in (5, {5: 1}):
        with pytest.raises(UserError) as error:
            env.reset(options=wrong)  # type: ignore[arg-type]
        assert "options are" in str(error.value)
    env.close()


def test_the_documented_client_runs(url: str) -> None:
    block = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "serve.md").read_text(), re.DOTALL)[0]
    names: dict[str, Any] = {}
    exec(block.replace("ws://127.0.0.1:8643", url).replace("max_steps=20", "max_steps=2"), names)
    names["env"].close()
    assert names["truncated"] and len(block.splitlines()) <= 11


def test_the_client_needs_no_jax() -> None:
    program = "import sys, rsjax.tools.serve.client; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], cwd=ROOT).returncode == 0
