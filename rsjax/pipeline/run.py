"""A run directory: which stages it holds, by which configuration, and how long they took.

Every stage has a content key of all that its output depends on; a stage whose mark has this key and says "finished" is
skipped. A mark under another key means another configuration.
"""

import json
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

from rsjax.config import Config, ConfigError, content_key, from_dict, to_dict
from rsjax.data.store import MANIFEST, Store, StoreError, open_store
from rsjax.data.token_sets import tokenizer_key, tokens_key
from rsjax.errors import UserError
from rsjax.files import disk_guard, write_atomically
from rsjax.sim.collect import collection_key

STAGES = ("collect", "tokenizer", "tokens", "world_model", "evaluation", "report")
TRAINED = ("tokenizer", "world_model")  # never replaced unasked
DECIDED_BY = {  # sections of the configuration that a trained stage depends on
    "tokenizer": ("sim", "data", "tokenizer", "tokenizer_train"),
    "world_model": ("sim", "data", "tokenizer", "tokenizer_train", "model", "mask", "loss", "train"),
}
OUTPUTS = {  # in the run directory; clips lie outside, and so do the tokens that the link there leads to
    "tokenizer": "tokenizer/weights",
    "tokens": "tokens/store",
    "world_model": "world_model/weights",
    "evaluation": "evaluation/result.msgpack",
    "report": "report.html",
}
RECIPE = 1  # raise it when the same configuration gives other results


class RunError(UserError):
    """A run directory that cannot be used as asked."""


@dataclass(frozen=True)
class Run:
    """One run: a configuration, its directory, and where data sets are kept."""

    config: Config
    directory: Path
    data_directory: Path

    @property
    def clips(self) -> Path:
        """The store of clips; shared by all runs that use the same episodes."""
        return Path(self.config.data.store or self.data_directory / f"lift-{self.keys()['collect']}")

    def open_clips(self) -> Store:
        """The store of clips.

        Raises:
            StoreError: it is gone or damaged, or another one than the run was made for lies there.
        """
        key = self.config.data.key
        if key and not (self.clips / MANIFEST).exists():
            raise StoreError(f"{self.clips}: no store is there; if it was moved, say where it lies with --store")
        store = open_store(self.clips)
        if key and store.manifest.get("key") != key:
            raise StoreError(
                f"{self.clips}: is not the store that the run began with (key {store.manifest.get('key')}, not {key}); "
                f"train on it in another --run-dir, or put the old one back"
            )
        return store

    def open_tokens(self) -> Store:
        """The store of tokens, where it really lies.

        Raises:
            StoreError: it is gone or damaged, or the tokens of other clips are there now.
        """
        store = open_store(self.output("tokens").resolve())
        if not self._made_of_these_clips(store.manifest):
            raise StoreError(f"{store.path}: holds tokens of other clips; the train command of this run makes its own")
        return store

    def _made_of_these_clips(self, tokens: dict[str, Any]) -> bool:
        """Whether a store of tokens with this manifest belongs to the run's own store, which may have been moved."""
        key, cfg = self.config.data.key, self.config
        return not key or tokens.get("key") == tokens_key(key, tokenizer_key(cfg, str(tokens.get("tokenizer"))))

    def keys(self) -> dict[str, str]:
        """Each stage's content key: its own settings and the key of the stage before."""
        cfg = self.config
        key = content_key("store", cfg.data.key) if cfg.data.key else collection_key(cfg.sim)
        keys = {"collect": key}
        settings: dict[str, tuple[Any, ...]] = {
            "tokenizer": (cfg.tokenizer, cfg.tokenizer_train),
            "tokens": (),
            "world_model": (cfg.model, cfg.mask, cfg.loss, cfg.train),
            "evaluation": (cfg.sample, cfg.eval),
            "report": (),
        }
        for stage, parts in settings.items():
            key = keys[stage] = content_key(RECIPE, stage, key, *parts)
        return keys

    def prepare(self, overwrite: bool) -> None:
        """Makes the directory, or checks that it belongs to this configuration, and writes ``config.json``.

        Args:
            overwrite: throw trained stages of another configuration away instead of refusing.

        Raises:
            RunError: it holds a trained stage of another configuration; the message names the differing fields.
        """
        for stage in TRAINED:
            if self.mark(stage).get("key", self.keys()[stage]) != self.keys()[stage]:
                if not overwrite:
                    raise RunError(
                        f"{self.directory} holds a {stage.replace('_', ' ')} of another configuration "
                        f"({self._differences(stage)}); choose another --run-dir, or train it again with --overwrite"
                    )
                shutil.rmtree(self.directory / stage)
        with disk_guard(self.directory):
            self.directory.mkdir(parents=True, exist_ok=True)
            write_atomically(self.directory / "config.json", json.dumps(to_dict(self.config), indent=1).encode())

    def _differences(self, stage: str) -> str:
        """The fields that make the stage in the directory another one; not those that change no result."""
        try:
            saved = _flat(to_dict(from_dict(Config, json.loads((self.directory / "config.json").read_text()))))
        except ConfigError as error:
            return f"of another version: {error}"
        except (OSError, ValueError, TypeError):
            return "its config.json is missing or damaged"
        here, free = _flat(to_dict(self.config)), _runtime_fields(self.config)
        names = [
            name
            for name in here | saved
            if here.get(name) != saved.get(name) and name not in free and name.partition(".")[0] in DECIDED_BY[stage]
        ]
        return "; ".join(f"{name} is {_told(saved, name)} there, {_told(here, name)} here" for name in names) or (
            "older code"
        )

    def output(self, stage: str) -> Path:
        """What the stage leaves: a file or directory that appears whole."""
        return self.clips if stage == "collect" else self.directory / OUTPUTS[stage]

    def finished(self, stage: str) -> bool:
        """Whether the stage's output is there and was made by this configuration."""
        mark = self.mark(stage)
        done = mark.get("key") == self.keys()[stage] and mark.get("finished", False)
        if not (done and self.output(stage).exists()):
            return False
        return stage != "tokens" or self._has_its_tokens()

    def _has_its_tokens(self) -> bool:
        try:
            manifest = json.loads((self.output("tokens") / MANIFEST).read_text())
        except (OSError, ValueError):
            return True  # the stage that reads them says what is wrong
        return self._made_of_these_clips(manifest)

    def mark(self, stage: str) -> dict[str, Any]:
        """What the directory knows of a stage: key, finished, seconds. Empty where it was not begun."""
        try:
            return json.loads(self._mark_path(stage).read_text())
        except (OSError, ValueError):
            return {}

    def _mark_path(self, stage: str) -> Path:
        return self.directory / stage / "stage.json"

    @contextmanager
    def stage(self, stage: str) -> Iterator[Path]:
        """Around a stage's work: gives its directory, and marks it as begun, then finished, with the seconds it took.

        Seconds add up over interruptions (but a killed process takes its own along).
        """
        folder, began = self.directory / stage, time.monotonic()
        mark = self.mark(stage)
        before = mark.get("seconds", 0.0) if mark.get("key") == self.keys()[stage] else 0.0
        finished = False
        self._write_mark(stage, before, finished)
        try:
            yield folder
            finished = True
        finally:
            self._write_mark(stage, before + time.monotonic() - began, finished)

    def _write_mark(self, stage: str, seconds: float, finished: bool) -> None:
        path = self._mark_path(stage)
        content = {"key": self.keys()[stage], "finished": finished, "seconds": round(seconds, 1)}
        with disk_guard(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, json.dumps(content).encode())


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values by dotted names, such as ``train.stages.0.epochs``."""
    out: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, list) and any(isinstance(item, dict) for item in value):
            value = {str(i): item for i, item in enumerate(value)}
        out |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return out


def _told(values: dict[str, Any], name: str) -> Any:
    value = values.get(name, "not set")
    return "empty" if value == "" else value


def _runtime_fields(config: Any, prefix: str = "") -> set[str]:
    names: set[str] = set()
    for field in fields(config):
        value, name = getattr(config, field.name), prefix + field.name
        if field.metadata.get("runtime"):
            names.add(name)
        elif is_dataclass(value):
            names |= _runtime_fields(value, f"{name}.")
    return names
