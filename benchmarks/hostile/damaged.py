"""Every kind of file that a command reads, damaged in every way, given to the commands that read it."""

import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.hostile.cases import Case, Ended, Place, command
from benchmarks.hostile.options import LINES, OWN_END

Damage = Callable[[Path, random.Random], None]

MORE = {
    "synthesize with the judge": f"{LINES['synthesize']} --judge",
    "plan with the judge": "plan MATERIAL/run --energy judge",
    "play with the policy": f"{LINES['play']} --policy MATERIAL/policy",
    "demo of the saved model": "demo MATERIAL/saved --video --out NEW",
    "generate from the saved model": "generate MATERIAL/saved --out NEW",
    "hub push": LINES["hub push"],
    "files: run/coverage/bank.msgpack": "it is made again where it cannot be read",
    "ingest lerobot": "ingest lerobot MATERIAL/synthetic/lerobot-v3.0 --out NEW --windows.frames 4 --workers 0",
    "doctor lerobot": "doctor lerobot MATERIAL/synthetic/lerobot-v3.0",
    "doctor lerobot v2.1": "doctor lerobot MATERIAL/synthetic/lerobot-v2.1",
    "doctor synthetic": "doctor MATERIAL/synthetic/clips",
    "split": LINES["store split"],
    "merge": LINES["store merge"],
    "train goes on": "train debug --run-dir NEW --data-dir MATERIAL/data",  # on a copy of the run
}

# Files of the material, the largest where a pattern has several, and the commands that read them.
FILES = {
    "run/config.json": (
        "generate",
        "evaluate",
        "adapt",
        "judge",
        "replay",
        "record",
        "synthesize",
        "plan",
        "serve",
        "save",
    ),
    "run/run.json": ("save", "train goes on"),
    "run/metrics.json": ("save", "compare"),
    "run/evaluation/result.json": ("compare", "adapt"),
    "run/tokens/units.json": ("generate", "synthesize"),
    "run/world_model/log.jsonl": ("adapt",),
    "run/world_model/made.json": ("train goes on", "generate"),
    "run/world_model/weights/ocdbt.process_0/d/*": ("generate", "play", "evaluate", "save"),
    "run/world_model/weights/_METADATA": ("generate", "synthesize"),
    "run/world_model/weights/checksums.json": ("generate", "synthesize"),
    "run/tokenizer/weights/ocdbt.process_0/d/*": ("generate", "synthesize"),
    "run/coverage/bank.msgpack": ("serve", "evaluate", "policy_evaluation"),
    "run/judge/judge.msgpack": ("synthesize with the judge", "plan with the judge", "improve", "serve"),
    "policy/policy.json": ("record", "adapt", "policy_evaluation", "play with the policy"),
    "policy/weights/ocdbt.process_0/d/*": ("record", "improve", "play with the policy"),
    "data/lift-*/manifest.json": ("generate", "train", "record"),
    "data/lift-*/test-*.array_record": ("generate", "serve"),
    "store/manifest.json": ("inspect", "doctor", "split", "merge", "export", "ingest"),
    "store/train-*.array_record": ("inspect", "doctor", "export", "split"),
    "store/train-labels.npy": ("inspect", "doctor", "split"),
    "saved/config.json": ("demo of the saved model", "generate from the saved model", "hub push"),
    "saved/model.safetensors": ("demo of the saved model", "generate from the saved model", "hub push"),
    "saved/clips/manifest.json": ("demo of the saved model",),
    "synthetic/clips/manifest.json": ("policy_learning", "doctor synthetic"),
    "synthetic/lerobot-v3.0/meta/info.json": ("ingest lerobot", "doctor lerobot"),
    "synthetic/lerobot-v3.0/meta/tasks.parquet": ("ingest lerobot", "doctor lerobot"),
    "synthetic/lerobot-v3.0/meta/provenance.json": ("ingest lerobot",),
    "synthetic/lerobot-v3.0/meta/rsjax.json": ("ingest lerobot",),
    "synthetic/lerobot-v3.0/meta/episodes/*/*.parquet": ("ingest lerobot", "doctor lerobot"),
    "synthetic/lerobot-v3.0/data/*/*.parquet": ("doctor lerobot",),
    "synthetic/lerobot-v3.0/videos/*/*/*.mp4": ("doctor lerobot",),
    "synthetic/lerobot-v2.1/meta/episodes.jsonl": ("doctor lerobot v2.1",),
}


def _write(content: bytes) -> Damage:
    return lambda path, rng: _replace(path, content)


def _replace(path: Path, content: bytes) -> None:
    path.unlink()
    path.write_bytes(content)


def _truncate(path: Path, rng: random.Random) -> None:
    content = path.read_bytes()
    _replace(path, content[: rng.randrange(1, max(2, len(content)))])


def _flip(path: Path, rng: random.Random) -> None:
    content = bytearray(path.read_bytes())
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    _replace(path, bytes(content))


def _noise(path: Path, rng: random.Random) -> None:
    _replace(path, rng.randbytes(path.stat().st_size))


def _longer(path: Path, rng: random.Random) -> None:
    _replace(path, path.read_bytes() + rng.randbytes(64))


def _delete(path: Path, rng: random.Random) -> None:
    path.unlink()


def _directory(path: Path, rng: random.Random) -> None:
    path.unlink()
    path.mkdir()


def _fifo(path: Path, rng: random.Random) -> None:
    path.unlink()
    os.mkfifo(path)


def _device(path: Path, rng: random.Random) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


ANY: dict[str, Damage] = {
    "empty": _write(b""),
    "truncated": _truncate,
    "with a flipped bit": _flip,
    "with another flipped bit": _flip,
    "of random bytes": _noise,
    "with more at its end": _longer,
    "deleted": _delete,
    "a directory": _directory,
    "a fifo": _fifo,
    "a link to /dev/zero": _device,
}
JSON: dict[str, Damage] = {
    "a number": _write(b"3"),
    "a list": _write(b'["x"]'),
    "an object without fields": _write(b"{}"),
    "nested deeply": _write(b"[" * 100_000),
    "in UTF-16": _write(b"\xff\xfe{\x00}\x00"),
}
# What may be accepted, and why: by a part of the case's name.
DOCUMENTED: dict[str, str] = {
    "ingest lerobot": "an episode that cannot be read is quarantined",
    "weights/checksums.json deleted": "weights of earlier versions have no checksums",
    "files: run/world_model/made.json": "it says whether a training is finished; the weights have checksums",
    "files: run/world_model/log.jsonl": "a line that cannot be read counts as torn; a changed one is a speed",
    "files: run/coverage/bank.msgpack": "without a bank that can be read, coverage is left out",
    "files: data/lift-*/manifest.json": "a data set without a manifest that can be read is simulated again",
    "files: data/lift-*/test-*.array_record": "a clip is read when it is asked for, and refused then",
    "plan with the judge": "the simulator opens first, and the judge is read then",
    "files: run/metrics.json": "the card has the scores that can be read",
    "files: saved/clips/manifest.json with a flipped bit": "a bit in a text, such as a name of an episode",
    "files: run/run.json with a flipped bit": "a bit in a text, such as the command",
    "files: run/tokens/units.json with a flipped bit": "a bit that leaves a number that is allowed",
    "files: store/manifest.json with a flipped bit": "a bit in a text, such as the source",
    "files: saved/config.json with a flipped bit": "a bit that turns a setting into another one that is allowed",
    "files: run/config.json with a": "a bit that turns a setting into another one that is allowed, as an editor would",
}


def cases() -> Iterator[Case]:
    """Yields a case for every file, damage and reader."""
    for pattern, readers in FILES.items():
        damages = ANY | (JSON if pattern.endswith(("json", "jsonl")) else {})
        for damage, act in damages.items():
            for reader in readers:
                name = f"files: {pattern} {damage}, {reader}"
                reason = next((why for part, why in DOCUMENTED.items() if part in name), "")
                parts = [part for part in Path(pattern).parts if "*" not in part]
                words = tuple(parts[-2:])
                if reader in OWN_END:
                    words = (*words, OWN_END[reader])
                yield Case(name, _reading(pattern, act, reader, name), words, reason)


def _reading(pattern: str, damage: Damage, reader: str, name: str) -> Callable[[Place], Ended]:
    line = MORE.get(reader) or LINES[reader]

    def act(place: Place) -> Ended:
        root = place.material
        if reader == "train goes on":
            root = place.scratch / "copy"
            shutil.copytree(place.material / "run", root / "run")
            (place.scratch / "new").symlink_to(root / "run")
        path = max(root.glob(pattern), key=lambda each: each.stat().st_size)
        kept = place.scratch / "kept"
        shutil.copy2(path, kept)
        try:
            damage(path, random.Random(name))
            return command(line.split(), place)
        finally:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
            shutil.copy2(kept, path)

    return act
