"""Resolves curricula: which records of which stores a training loop reads, in which stages."""

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.config import ComponentConfig, CurriculumStageConfig, LoopConfig, TrainConfig
from rsjax.data.codec import Record
from rsjax.data.loader import Arrays, CurriculumStage, Loader, MixtureComponent, Readable, Transform, place_of
from rsjax.data.quarantine import NAME, Quarantine
from rsjax.data.state_labels import provenance_within
from rsjax.data.store import Store, StoreError, open_store

SPLIT = "train"
# The axis of frames in the arrays of a token record.
FRAME_AXES = {
    "rgb": 0,
    "depth": 0,
    "actions": 0,
    "success": 0,
    "tracks": 1,
    "visible": 1,
    "rgb_shifted": 1,
    "depth_shifted": 1,
    "second": 0,
}
EVERYTHING = CurriculumStageConfig()


@dataclass(frozen=True)
class LoaderFactory:
    """Makes the loaders of a training loop: ``factory(state)`` resumes from a loader's state, or begins if it is None.

    Attributes:
        loop: the loop, with ``steps`` and ``restarts`` of its stages.
        stages: the resolved stages.
        quarantine: the file that lists damaged records.
    """

    loop: LoopConfig
    stages: tuple[CurriculumStage, ...]
    quarantine: Path

    def __call__(self, state: dict[str, Any] | None) -> Loader:
        loop = self.loop
        chosen: dict[str, list[np.ndarray]] = {}
        for part in (part for stage in self.stages for part in stage.components):
            numbers = np.arange(len(part.source)) if part.chosen is None else part.chosen
            chosen.setdefault(place_of(part.source, 0)["store"], []).append(numbers)
        distinct = sum(len(np.unique(np.concatenate(numbers))) for numbers in chosen.values())
        listed = Quarantine(self.quarantine, distinct, loop.max_damaged)
        return Loader(self.stages, loop.batch_size, loop.seed, listed, workers=loop.workers, state=state)

    def replay(self, state: dict[str, Any]) -> Arrays:
        """Returns the next batch of a loader in this state, with the rows of all processes."""
        with self(None).whole(state) as loader:
            return next(loader)

    def summary(self) -> list[str]:
        """Returns a line for each stage of the curriculum, with its number of clips and its steps."""
        lines = []
        first = 0
        for number, stage in enumerate(self.stages[: len(self.loop.curriculum)], 1):
            last = first + stage.records // self.loop.batch_size
            clips = " + ".join(str(len(part)) for part in stage.components)
            lines.append(f"stage {number} of the curriculum: {clips} clips, steps {first + 1} to {last}")
            first = last
        return lines


def loader_factory(loop: LoopConfig, own: Store, transform: Transform, directory: Path) -> LoaderFactory:
    """Resolves the stages of a loop's curriculum into records and steps, and returns what makes its loaders.

    Args:
        loop: the loop; without a ``curriculum`` it reads all of ``own`` for ``loop.steps`` steps.
        own: the store that components read unless they name another.
        transform: of all stores' records.
        directory: where the list of damaged records is.

    Returns:
        The factory of its loaders; its ``loop`` has ``steps`` (of each stage, rounded up to whole batches),
        ``restarts`` and ``last_stage`` set.

    Raises:
        StoreError: a component's store cannot be read or mixed with ``own``, or no record passes its patterns.
    """
    resolved = [_resolve(stage, loop.batch_size, own, transform) for stage in loop.curriculum or (EVERYTHING,)]
    if loop.curriculum:
        steps = [stage.records // loop.batch_size for stage in resolved]
        firsts = np.cumsum([0, *steps]).tolist()
        restarts = tuple(
            first for first, stage in zip(firsts, loop.curriculum, strict=False) if stage.restart and first > 0
        )
        loop = replace(loop, steps=firsts[-1], restarts=restarts, last_stage=firsts[-2])
    return LoaderFactory(loop, tuple(resolved), directory / NAME)


def check_stages(train: TrainConfig, own: Store) -> list[Store]:
    """Checks early that the stages' stores exist and, if they are labelled, that some record passes the patterns.

    Returns:
        These stores, ``own`` first.

    Raises:
        StoreError: as from :func:`loader_factory`.
    """
    others = []
    for part in (part for stage in train.curriculum for part in stage.components):
        store = open_store(part.store) if part.store else own
        others += [store] if part.store else []
        if store.labelled(SPLIT):
            choose(part, store)
    return [own, *others]


def choose(part: ComponentConfig, store: Store) -> np.ndarray | None:
    """Returns the numbers of the first ``part.clips`` records that pass a component's patterns; None for all records.

    Raises:
        StoreError: no record passes; the message lists the store's words in the columns of the patterns.
    """
    patterns = {"difficulty": part.difficulties, "task": part.tasks, "scene": part.scenes}
    patterns = {name: allowed for name, allowed in patterns.items() if "*" not in allowed}
    if not patterns:
        return np.arange(min(part.clips, len(store.source(SPLIT)))) if part.clips else None
    labels = store.labels(SPLIT)
    if missing := [name for name in patterns if name not in labels.words]:
        raise StoreError(
            f"{store.path}: its records name no {' and no '.join(missing)}, only {', '.join(labels.words)}; make it "
            f"again, or change the stage's patterns"
        )
    chosen = np.flatnonzero(labels.matching(patterns))
    if not len(chosen):
        counts = labels.counts()
        words = {name: ", ".join(f"{word!r} {n}×" for word, n in sorted(counts[name].items())) for name in patterns}
        listed = "; ".join(f"{name} {counted}" for name, counted in words.items())
        wanted = " and ".join(f"a {name} like {' or '.join(allowed)}" for name, allowed in patterns.items())
        raise StoreError(
            f"{store.path}: no {SPLIT} record has {wanted}; it has {listed}: change the stage's patterns "
            f"(an entry without patterns reads everything), or label the clips when you ingest them "
            f"(--difficulty, --scene)"
        )
    return chosen[: part.clips or None]


def record_count(part: ComponentConfig, own: Store) -> int:
    """Returns how many records a component draws from.

    Raises:
        StoreError: its store cannot be read, or no record passes its patterns.
    """
    store = open_store(part.store) if part.store else own
    chosen = choose(part, store)
    return len(store.source(SPLIT)) if chosen is None else len(chosen)


def _resolve(stage: CurriculumStageConfig, batch_size: int, own: Store, transform: Transform) -> CurriculumStage:
    components = []
    for config in stage.components:
        assert config.annotations == "own", "the pipeline names the store that has the estimates"
        store = open_store(config.store) if config.store else own
        read = transform
        if stage.frames:
            read = partial(first_frames, transform, stage.frames)
        component = MixtureComponent(store.source(SPLIT), read, choose(config, store), config.weight)
        if not len(component):
            raise StoreError(f"{store.path}: its {SPLIT} split has no records; make it again")
        if config.store:
            theirs, ours = ({name: one.manifest.get(name) for name in ("kind", "tokenizer")} for one in (store, own))
            _require_alike(store, own, theirs, ours, needs="records of one kind, made with the same tokenizer")
            own_shapes = _shapes(MixtureComponent(own.source(SPLIT), read))
            _require_alike(store, own, _shapes(component), own_shapes, needs="clips of one length and size")
        components.append(component)
    drawn = stage.epochs * sum(map(len, components))
    # Epochs such as 0.1 are not exact in binary, so a value just above a whole number of batches counts as that number.
    batches = max(1, math.ceil(drawn / batch_size - 1e-6))
    return CurriculumStage(tuple(components), batches * batch_size)


def first_frames(transform: Transform, frames: int, record: Record, rng: np.random.Generator) -> Arrays:
    """Returns the arrays of a token record that is cut to its first frames.

    Raises:
        StoreError: the record has fewer frames, or is not of tokens.
    """
    if record["rgb"].ndim != 3 or len(record["rgb"]) < frames:
        raise StoreError(
            f"a stage of the curriculum takes {frames} frames, which a record of shape {record['rgb'].shape} does not "
            f"have; leave frames out, or lower it (only families of tokens know it)"
        )
    cut = dict(record)
    for name, axis in FRAME_AXES.items():
        if cut.get(name) is not None:
            cut[name] = np.take(cut[name], range(frames), axis=axis)
    cut["provenance"] = provenance_within(record["provenance"], slice(frames))
    return transform(cut, rng)


def _require_alike(store: Store, own: Store, theirs: dict[str, Any], ours: dict[str, Any], needs: str) -> None:
    for name in theirs | ours:
        if theirs.get(name) != ours.get(name):
            raise StoreError(
                f"{store.path}: its {name} is {theirs.get(name)}, that of {own.path} is {ours.get(name)}; a mixture "
                f"needs {needs}"
            )


def _shapes(component: MixtureComponent) -> dict[str, str]:
    _, record = Readable(component, Quarantine(None, len(component.source), 1.0))[0]
    arrays = component.transform(record, np.random.default_rng(0))
    return {name: f"{array.dtype} {array.shape}" for name, array in arrays.items()}
