"""A run directory: its stages, the configuration that made them, and their durations.

The content key of a stage covers everything that its output depends on. A stage is skipped if its folder is finished
under this key (:mod:`rsjax.artifact`); a folder with another key was made by another configuration.
"""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from rsjax.artifact import Mark, is_finished, make_once, read_mark
from rsjax.config import Config, ConfigError, content_key, from_dict, sampling_settings, to_dict
from rsjax.data.store import MANIFEST, Store, StoreError, open_store
from rsjax.data.token_sets import tokenizer_key, tokens_key
from rsjax.errors import UserError
from rsjax.files import FileError, holder, lock, read_json, write_json
from rsjax.model_directory import CLIPS, is_saved
from rsjax.tools.sim.collect import collection_key

STAGES = ("collect", "tokenizer", "tokens", "world_model", "evaluation", "report")  # and, if asked for, depth_estimator
TRAINED = ("tokenizer", "world_model")  # replaced only with --overwrite
DECIDED_BY = {  # sections of the configuration that a trained stage depends on
    "tokenizer": ("sim", "data", "tokenizer", "tokenizer_train"),
    "world_model": ("sim", "data", "tokenizer", "tokenizer_train", "model", "prompt_frames", "train"),
}
OUTPUTS = {  # in the run directory; clips and depth estimator are elsewhere, and "tokens" is a link
    "tokenizer": "tokenizer/weights",
    "tokens": "tokens/store",
    "world_model": "world_model/weights",
    "evaluation": "evaluation/result.msgpack",
    "report": "report.html",
}
RECIPE = 1  # increase it when the same configuration gives new results


class RunError(UserError):
    """A run directory belongs to another configuration, or another process is working in it."""


@dataclass(frozen=True)
class Run:
    """One run: its configuration, its directory, and the directory of simulated data sets."""

    config: Config
    directory: Path
    data_directory: Path

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages of this run; a model without tokens needs no tokenizer, and few runs train a depth estimator."""
        stages = [stage for stage in STAGES if stage != "tokenizer" or self.config.model.uses_tokenizer]
        if self.config.eval.simulator_steps:
            stages.insert(stages.index("evaluation"), "depth_estimator")
        return tuple(stages)

    @property
    def clips(self) -> Path:
        """The path of the store of clips, which all runs on the same episodes share; a saved model has its own."""
        if is_saved(self.directory):
            return self.directory / CLIPS
        if self.config.data is not None:
            return Path(self.config.data.store)
        return self.data_directory / f"{self.config.sim.env}-{self._collect_key}"

    def open_clips(self) -> Store:
        """Opens the store of clips.

        Raises:
            StoreError: the store is missing or damaged, or another store is in its place.
        """
        key = self.config.data.key if self.config.data is not None else ""
        if is_saved(self.directory):
            key = ""  # a few of the clips have a key of their own
        if key and not (self.clips / MANIFEST).exists():
            raise StoreError(f"{self.clips}: the store is missing; if it was moved, name its new path with --store")
        store = open_store(self.clips)
        if key and store.manifest.get("key") != key:
            raise StoreError(
                f"{self.clips}: is not the store that the run began with (key {store.manifest.get('key')}, not {key}); "
                f"train on it in another --run-dir, or restore the old one"
            )
        return store

    def open_prepared(self) -> Store:
        """Opens the store that the world model trains on: tokens, or the clips themselves.

        Raises:
            StoreError: the store is missing or damaged, or was made from other clips.
        """
        store = open_store(self.output("tokens").resolve())
        if not self._made_of_these_clips(store.manifest):
            raise StoreError(f"{store.path}: holds tokens of other clips; the train command of this run makes its own")
        return store

    def _made_of_these_clips(self, prepared: dict[str, Any]) -> bool:
        """Returns whether a store with this manifest was made from the run's clips, which may have moved."""
        key = self.config.data.key if self.config.data is not None else ""
        if not key or not self.config.model.uses_tokenizer:
            return not key or prepared.get("key") == key
        shifts = prepared.get("shifts", ())
        tokenizer = tokenizer_key(self.config.autoencoder, str(prepared.get("tokenizer")), *shifts)
        return prepared.get("key") == tokens_key(key, tokenizer)

    def keys(self) -> dict[str, str]:
        """Returns each stage's content key, a hash of its settings and the previous stage's key.

        The key of the depth estimator depends on the clips alone, so that all runs on the same clips share it.
        """
        cfg = self.config
        key = self._collect_key
        keys = {"collect": key}
        if cfg.eval.simulator_steps:
            keys["depth_estimator"] = content_key(RECIPE, "depth_estimator", key, cfg.eval.simulator_steps)
        evaluation = cfg.eval
        with suppress(UserError):  # a file that cannot be read: the evaluation reports what is wrong
            from rsjax.tools.pipeline.metric_files import by_content  # here, because it loads jax

            evaluation = by_content(cfg.eval)
        settings: dict[str, tuple[Any, ...]] = {
            "tokenizer": (cfg.autoencoder, cfg.tokenizer_train, *validated_on(cfg, "tokenizer").values()),
            "tokens": cfg.model.token_shifts,
            "world_model": (cfg.model, cfg.prompt_frames, cfg.train, *validated_on(cfg, "world_model").values()),
            "evaluation": (sampling_settings(cfg.model), evaluation),
            "report": (),
        }
        for stage, parts in settings.items():
            if stage not in self.stages:
                continue
            key = content_key(RECIPE, stage, key, *parts)
            keys[stage] = key
        return keys

    @property
    def _collect_key(self) -> str:
        cfg = self.config
        return collection_key(cfg.sim) if cfg.data is None else content_key("store", cfg.data.key)

    @property
    def lock_file(self) -> Path:
        """The lock that a process holds while it makes stages here."""
        return self.directory / ".lock"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keeps other processes from making stages here; processes that only read are not locked out.

        Raises:
            RunError: another process is making stages here; the message names it.
        """
        with lock(self.lock_file, required=False) as free:
            if not free:
                raise RunError(
                    f"{self.directory}: {holder(self.lock_file)} is training here; wait for it, stop it, or choose "
                    f"another --run-dir"
                )
            yield

    def prepare(self, overwrite: bool) -> None:
        """Makes the directory, or checks that it fits this configuration, and writes ``config.json``.

        Args:
            overwrite: whether to delete trained stages of another configuration instead of refusing.

        Raises:
            RunError: the directory contains a trained stage of another configuration (the message names the fields), or
                the configuration has clips of a shape alone.
        """
        if self.config.data is not None and not self.config.data.key:
            raise RunError(
                f"{self.config.name} trains on a store of clips, and none is named: make it with rsjax ingest, and add "
                f"--store STORE (docs/agibot.md)"
            )
        if is_saved(self.directory):
            raise RunError(f"{self.directory}: is a saved model; train in another --run-dir, with --train.start-from")
        for stage in (stage for stage in TRAINED if stage in self.stages):
            aside = self.directory / f"{stage}.old"
            shutil.rmtree(aside, ignore_errors=True)  # left by a command that was killed here
            if self._key_of_content(stage) not in (None, self.keys()[stage]):
                if not overwrite:
                    raise RunError(
                        f"{self.directory} holds a {stage.replace('_', ' ')} of another configuration "
                        f"({self._differences(stage)}); choose another --run-dir, or train it again with --overwrite"
                    )
                os.replace(self.directory / stage, aside)  # atomic, because half a stage might be resumed
                shutil.rmtree(aside)
        write_json(self.directory / "config.json", to_dict(self.config))

    def _key_of_content(self, stage: str) -> str | None:
        """Returns the key of the trained stage in the directory, from its mark, or from config.json without a mark."""
        if mark := self.mark(stage):
            return mark.key
        if not (self.directory / stage / "checkpoints").exists():
            return None
        try:
            return replace(self, config=self._saved_config()).keys().get(stage, "")
        except (ConfigError, FileError, TypeError):
            return ""

    def _saved_config(self) -> Config:
        return from_dict(Config, read_json(self.directory / "config.json"))

    def _differences(self, stage: str) -> str:
        """Describes the fields that differ from the saved stage's, except fields without effect on results."""
        try:
            saved = self._saved_config()
        except ConfigError as error:
            return f"of another version: {error}"
        except (FileError, TypeError):
            return "its config.json is missing or damaged"
        decided = []
        for config in (saved, self.config):
            own = config.model.own_autoencoder
            values = validated_on(config, stage)
            for part in DECIDED_BY[stage]:
                if part == "tokenizer" and own is not None:
                    values |= dict(_deciding(own, "model.autoencoder"))
                else:
                    values |= dict(_deciding(getattr(config, part), part))
            decided.append(values)
        there, here = decided
        pairs = {name: (there.get(name, "not set"), here.get(name, "not set")) for name in here | there}
        return "; ".join(f"{name} is {a} there, {b} here" for name, (a, b) in pairs.items() if a != b) or "older code"

    def output(self, stage: str) -> Path:
        """Returns the path of the stage's output, a file or directory that is written atomically."""
        if stage == "collect":
            return self.clips
        if stage == "depth_estimator":
            return self.data_directory / f"depth-estimator-{self.keys()[stage]}"
        return self.directory / OUTPUTS[stage]

    def finished(self, stage: str) -> bool:
        """Returns whether the stage's output exists and was made by this configuration."""
        done = is_finished(self.directory / stage, self.keys()[stage]) and self.output(stage).exists()
        if not done or stage != "tokens":
            return done
        try:
            manifest = read_json(self.output("tokens") / MANIFEST)
        except FileError:
            return True  # the stage that reads the clips reports the damage
        return self._made_of_these_clips(manifest)

    def mark(self, stage: str) -> Mark | None:
        """Reads what is known of a stage; None if it was never started, or if its mark is damaged."""
        return read_mark(self.directory / stage)

    def seconds(self, stage: str) -> float:
        """Returns how long a stage has taken, over all interruptions; 0 if it was never started."""
        mark = self.mark(stage)
        return 0.0 if mark is None else mark.seconds

    @contextmanager
    def stage(self, stage: str) -> Iterator[Path]:
        """Marks a stage as begun and, after its work, as finished, with its duration; yields its directory.

        The caller holds the run's lock. A trained stage of another configuration is gone (:meth:`prepare`); of the
        other stages, the work replaces each file.
        """
        folder = self.directory / stage
        with make_once(folder, self.keys()[stage], refuse=None, again=True, keep=True, locked=False):
            yield folder


def validated_on(config: Config, stage: str) -> dict[str, Any]:
    """Returns the settings of the validation that chooses a stage's weights, by name; empty without an early stop."""
    if stage == "tokenizer" and config.tokenizer_train.early_stop is not None:
        return {"eval.clips": config.eval.clips}
    if stage == "world_model" and config.train.early_stop is not None:
        return {"eval.batch_size": config.eval.batch_size, "model.sample": sampling_settings(config.model)}
    return {}


def _deciding(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yields the fields that affect results, by dotted name such as ``train.curriculum.0.epochs``."""
    if isinstance(value, tuple) and any(map(is_dataclass, value)):
        for i, item in enumerate(value):
            yield from _deciding(item, f"{name}.{i}")
    elif is_dataclass(value):
        decide = [field.name for field in fields(value) if not field.metadata.keys() & {"runtime", "sampling"}]
        for key in ["family"] * hasattr(value, "family") + decide:
            yield from _deciding(getattr(value, key), f"{name}.{key}")
    else:
        yield name, "empty" if value == "" else value


def link(target: Path, at: Path) -> None:
    """Makes ``at`` a link to ``target``, atomically; replaces what was at that path."""
    temporary = at.with_name(f"{at.name}.{os.getpid()}.tmp")
    temporary.unlink(missing_ok=True)
    if at.is_dir() and not at.is_symlink():  # a copied run contains the tokens themselves
        shutil.rmtree(at)
    temporary.symlink_to(target)
    os.replace(temporary, at)
