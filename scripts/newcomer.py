"""What a newcomer does with the installed package, outside any checkout; ``scripts/wheel.sh`` calls it.

Each step is a function, and prints how long it took. It uses nothing but the package and what came with it.
"""

import json
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

STEPS: list[Callable[[], None]] = []


def step(function: Callable[[], None]) -> Callable[[], None]:
    """Adds a step."""
    STEPS.append(function)
    return function


def rsjax(*words: str) -> str:
    """Runs the command, which must succeed, and returns what it prints."""
    done = subprocess.run(["rsjax", *words], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"rsjax {' '.join(words)} ended with {done.returncode}:\n{done.stdout}{done.stderr}")
    return done.stdout


def written(printed: str) -> list[Path]:
    """Returns the files that a command names, one on each line."""
    return [path for path in map(Path, printed.splitlines()) if path.is_file()]


@step
def commands_are_listed() -> None:
    assert "rsjax demo" in rsjax("--help")
    assert "usage" in rsjax("train", "tiny", "--help")


@step
def the_package_is_the_installed_one_alone() -> None:
    import rsjax as package

    folder = Path(package.__file__).parent
    assert folder.parent.name == "site-packages", folder
    assert (folder / "py.typed").exists()
    for name in ("experiments", "tests", "scripts", "benchmarks"):
        assert not (folder.parent / name).exists(), f"the wheel holds {name}"
    for name in ("mujoco", "robosuite", "torch"):
        assert not (folder.parent / name).exists(), f"{name} came with the wheel"


@step
def demo_writes_a_video_and_a_picture() -> None:
    files = written(rsjax("demo", "--video"))
    assert [file.suffix for file in files] == [".mp4", ".png"], files
    assert all(file.stat().st_size > 10_000 for file in files)


@step
def three_lines_of_python_generate() -> None:
    import rsjax as package

    model = package.load("tiny")
    clip = package.examples("tiny")[0]
    video = model.generate(clip["rgb"][:1], clip["actions"])
    assert video.rgb.shape == clip["rgb"].shape


@step
def generate_writes_videos() -> None:
    files = written(rsjax("generate", "tiny", "--clips", "0", "1", "--actions-from", "2", "--format", "gif"))
    assert [file.parent for file in files] == 2 * [Path("runs/tiny/generated")], files


@step
def a_tiny_lerobot_set_is_finetuned_on() -> None:
    import rsjax as package

    examples = package.examples("tiny")
    clips = [examples[number] for number in range(len(examples))]
    clips = [{"rgb": clip["rgb"], "actions": clip["actions"], "fps": 5.0} for clip in clips]
    package.write_store("clips", clips)
    rsjax("export", "lerobot", "clips", "lerobot")
    printed = rsjax("finetune", "tiny", "--data", "lerobot:lerobot", "--out", "runs/mine", "--steps", "20")
    assert "the model's tokenizer" in printed and "repeating the first frame" in printed, printed
    assert (Path("runs/mine") / "report.html").exists()


@step
def play_serves_the_page_and_a_frame_is_driven() -> None:
    from websockets.sync.client import connect

    line = ["rsjax", "play", "tiny", "--port", "0", "--no-browser"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            address = next(line.split()[0] for line in server.stdout if line.startswith("http"))
            with urllib.request.urlopen(address) as page:
                assert b"<html" in page.read()
            with connect(address.replace("http", "ws", 1) + "ws", max_size=2**24) as socket:
                sources = json.loads(socket.recv())["sources"]
                assert sources["clip"] == "", sources
                socket.send(json.dumps({"type": "start", "id": 1, "clip": 0}))
                answer(socket, 1, "session")
                socket.send(json.dumps({"type": "step", "id": 2, "branch": 0, "source": {"kind": "random"}}))
                assert answer(socket, 2, "stepped")["frame"] == 1
        finally:
            server.terminate()


@step
def serve_answers_a_client() -> None:
    from rsjax.tools.serve.client import WorldClient

    line = ["rsjax", "serve", "tiny", "--port", "0"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            address = next(text.split()[0] for text in server.stdout if text.startswith("ws://"))
            with WorldClient(address) as client:
                client.reset(clip=0)
                assert client.step(client.metadata["action_low"])["frame"] == 1
        finally:
            server.terminate()


def answer(socket: object, number: int, kind: str) -> dict:
    """Returns the final answer to a message, which must be of this type; pictures come before it."""
    pictures = 0
    while True:
        message = socket.recv(timeout=60)  # type: ignore[attr-defined]
        if isinstance(message, bytes):
            pictures += 1
            continue
        content = json.loads(message)
        if content.get("id") == number and content["type"] in (kind, "error"):
            assert content["type"] == kind and pictures, content
            return content


def main() -> None:
    """Runs the steps whose names contain one of the arguments; without arguments, all."""
    for function in STEPS:
        if sys.argv[1:] and not any(word in function.__name__ for word in sys.argv[1:]):
            continue
        began = time.monotonic()
        function()
        print(f"{function.__name__.replace('_', ' ')}: {time.monotonic() - began:.1f} s", flush=True)


if __name__ == "__main__":
    main()
