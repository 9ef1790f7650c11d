"""Checks whether the code still does bit for bit what it did when ``tests/behaviour.json`` was recorded.

``python -m tests.behaviour record`` writes the file, ``python -m tests.behaviour check`` compares with it (four minutes
on 2 cores). The file records the losses of ``tiny`` over 100 steps of both training stages, the metrics of ``debug``,
the tokens of a greedy rollout, generated videos, the bytes of a store into which BridgeData was ingested, parameters
of every preset by shape, and the pictures of a played session. Floating-point results differ between
processors, so a record from another processor is refused, not compared.
"""

import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

RECORD = Path(__file__).with_suffix(".json")
BRIDGE = Path(__file__).parents[2] / "shared" / "data" / "bridge"
SECTIONS = ("tokenizer-train", "train")
MEASURED = ("second", "share", "gib")  # words in the names of scalars that measure the machine, not the code's results


def main() -> None:
    """Records the behaviour, or checks it against the record."""
    action = sys.argv[1] if len(sys.argv) > 1 else "check"
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(os.environ.get("BEHAVIOUR_DIR") or scratch)
        now: dict[str, Any] = {
            "machine": machine(),
            "tiny": tiny(place),
            "debug": debug(place),
            "tokens": tokens(place),
        }
        now |= {"videos": videos(place), "bridge": bridge(place), "presets": presets(), "session": session(place)}
    if action == "record":
        RECORD.write_text(json.dumps(now, indent=1, sort_keys=True) + "\n")
        return
    then = json.loads(RECORD.read_text())
    if then["machine"] != now["machine"]:
        raise SystemExit(f"recorded on {then['machine']}, this is {now['machine']}: bits cannot be compared")
    differing = [line for part in then for line in compare(part, then[part], now[part])]
    print("\n".join(differing) or "bit-identical")
    raise SystemExit(bool(differing))


def machine() -> str:
    """Returns the processor's name, its number of cores and jax's version."""
    import jax

    lines = Path("/proc/cpuinfo").read_text().splitlines()
    name = next((line.partition(": ")[2] for line in lines if line.startswith("model name")), platform.processor())
    return f"{name}, {os.cpu_count()} cores, jax {jax.__version__}"


def compare(name: str, then: Any, now: Any) -> list[str]:
    """Returns a line for every value that differs."""
    if isinstance(then, dict) and isinstance(now, dict):
        return [line for key in sorted({*then, *now}) for line in compare(f"{name}/{key}", then.get(key), now.get(key))]
    return [] if then == now else [f"{name}: {then} then, {now} now"]


def run(module: str, *arguments: str) -> None:
    """Runs one of the commands."""
    subprocess.run([sys.executable, "-m", f"experiments.{module}", *arguments], check=True)


def curve(directory: Path) -> dict[str, dict[str, float]]:
    """Returns the logged scalars by step, without those that measure the machine."""
    rows = [json.loads(line) for line in (directory / "log.jsonl").read_text().splitlines()]
    return {
        str(row["step"]): {name: value for name, value in row.items() if not any(word in name for word in MEASURED)}
        for row in rows
    }


def tiny(place: Path) -> dict[str, Any]:
    """Trains ``tiny`` for 100 steps per stage on few episodes, and returns both training curves."""
    short = [*(f"--{section}.steps=100" for section in SECTIONS), "--runtime.log-every=1"]
    few = ["--sim.episodes=40", "--sim.test-episodes=4", "--eval.clips=2", "--eval.action-draws=1"]
    off = ["--runtime.eval-every=0"]
    run("train", "roboscape_tiny", "--run-dir", f"{place}/tiny", "--data-dir", f"{place}/data", *short, *few, *off)
    return {stage: curve(place / "tiny" / stage) for stage in ("tokenizer", "world_model")}


def debug(place: Path) -> dict[str, Any]:
    """Runs ``debug``, and returns its metrics."""
    run("train", "debug", "--run-dir", f"{place}/debug", "--data-dir", f"{place}/data")
    metrics = json.loads((place / "debug" / "metrics.json").read_text())
    return {name: value for name, value in metrics.items() if "second" not in name}


def tokens(place: Path) -> dict[str, str]:
    """Returns digests of the tokens of a greedy rollout by the model that :func:`tiny` trained."""
    from rsjax.data.clips import Clips
    from rsjax.models.load_run import load
    from rsjax.tools.pipeline.run import Run
    from rsjax.tools.pipeline.videos import resampled

    trained = resampled(load(place / "tiny"), {"temperature": 0.0, "unmask": "greedy", "steps": 3})
    source = Run(trained.config, place / "tiny", place / "data").open_clips().source("test")
    clips = Clips.stacked([source[number] for number in range(4)], range(4))
    made = rollout_tokens(trained, clips)
    digest = lambda grid: hashlib.sha256(np.asarray(grid).astype("<i4").tobytes()).hexdigest()  # noqa: E731
    return {branch: digest(grid) for branch, grid in made.items()}


def rollout_tokens(trained: Any, clips: Any) -> dict[str, Any]:
    """Returns the tokens of the videos generated under the clips' own actions."""
    import jax

    from rsjax.models.roboscape.sample import rollout
    from rsjax.tokenizers.codec import Codec

    model, codec = (
        trained.model,
        Codec(trained.config.tokenizer, trained.assets.tokenizer, trained.assets.normalization),
    )
    prompt = codec.encode(clips.video.frames(0, 1))
    actions = codec.normalization.action_inputs(clips.actions, model.config.departures.integrate_actions)
    sample = model.config.sample
    return rollout(model.architecture, sample, trained.params, prompt, actions, jax.random.key(sample.seed))


def videos(place: Path) -> dict[str, str]:
    """Returns digests of videos that the public API generates with the model that :func:`tiny` trained."""
    import rsjax

    model = rsjax.load(place / "tiny")
    (store,) = [path for path in (place / "data").glob("lift-*") if len(list(path.glob("*.array_record"))) > 0][:1]
    sizes = {len(rsjax.open_store(path).source("test")): path for path in (place / "data").glob("lift-*")}
    source = rsjax.open_store(sizes.get(4, store)).source("test")
    clip = source[0]
    video = model.generate(clip["rgb"][:1], clip["actions"], depth=clip["depth"][:1])
    planned = model.plan(clip["rgb"][:1], np.stack([source[i]["actions"] for i in range(3)]), clip["depth"][:1])
    arrays = {"rgb": video.rgb, "depth": video.depth, "planned": planned.rgb}
    return {name: hashlib.sha256(np.ascontiguousarray(x).tobytes()).hexdigest() for name, x in arrays.items()}


def presets() -> dict[str, dict[str, Any]]:
    """Returns the number of parameters of each preset's networks, and a digest of their names, shapes and types."""
    import jax

    from rsjax.config import presets
    from rsjax.models.base import create_autoencoder, create_model

    found = {}
    for name in presets.PRESETS:
        config = presets.get(name)
        networks = {"model": create_model(config), "autoencoder": create_autoencoder(config)}
        for part, network in networks.items():
            shapes = jax.eval_shape(network.init, jax.random.key(0))
            lines = sorted(f"{jax.tree_util.keystr(path)} {x.shape} {x.dtype}" for path, x in leaves_of(shapes))
            found[f"{name}/{part}"] = {
                "parameters": sum(x.size for _, x in leaves_of(shapes)),
                "digest": hashlib.sha256("\n".join(lines).encode()).hexdigest(),
            }
    return found


def leaves_of(tree: Any) -> list[Any]:
    """Returns paths and leaves of a tree."""
    import jax

    return jax.tree_util.tree_leaves_with_path(tree)


def session(place: Path) -> list[str]:
    """Plays ``tiny`` over the page's socket, and returns digests of the pictures that came."""
    from websockets.sync.client import connect

    arguments = [f"{place}/tiny", "--data-dir", f"{place}/data", "--port", "0", "--no-browser"]
    command = [sys.executable, "-m", "experiments.play", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        address = next(line for line in process.stdout if line.startswith("http")).split()[0]
        pictures = []
        with connect(address.replace("http", "ws").rstrip("/") + "/ws", max_size=2**24) as socket:
            socket.recv(600)
            messages: list[dict[str, Any]] = [{"type": "start", "clip": 1, "seed": 5}]
            messages += [{"type": "step", "branch": 0, "source": {"kind": "clip"}}] * 5
            messages += [{"type": "branch", "branch": 0, "frame": 2}]
            messages += [{"type": "step", "branch": 0, "action": [0.5, 0, 0, 0, 0, 0, 1]}] * 3
            for number, message in enumerate(messages, 1):
                socket.send(json.dumps(message | {"id": number}))
                while True:
                    answer = socket.recv(600)
                    if isinstance(answer, bytes):
                        pictures.append(hashlib.sha256(answer).hexdigest())
                    elif json.loads(answer).get("id") == number and json.loads(answer)["type"] != "progress":
                        pictures.append(json.loads(answer)["type"])
                        break
        return pictures
    finally:
        process.terminate()
        process.wait()


def bridge(place: Path) -> dict[str, str] | None:
    """Ingests BridgeData, and returns digests of the files of clips; None if the data set is missing."""
    if not BRIDGE.exists():
        return None
    out = place / "bridge"
    run("ingest", "rlds", str(BRIDGE), "--out", str(out), "--windows.rate", "0", "--windows.frames", "8")
    files = [path for path in sorted(out.rglob("*")) if path.is_file() and path.suffix == ".array_record"]
    return {path.relative_to(out).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


if __name__ == "__main__":
    main()
