"""Makes a saved model of a finished run: its weights, a few held-out clips, and a card made of the run's records."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from rsjax.artifact import read_mark
from rsjax.data.clips import Clips, frame_rate, load_clips, readable, spread
from rsjax.data.store import Store, write_store
from rsjax.errors import UserError
from rsjax.evaluation.metrics.psnr import psnr
from rsjax.evaluation.registry import metrics
from rsjax.files import read_json, write_file, write_json
from rsjax.model_directory import CARD, CLIPS, Dtype
from rsjax.models.card import LIMITS, model_card
from rsjax.models.load_run import load
from rsjax.models.trained import TrainedModel
from rsjax.tools.pipeline.provenance import read_starts
from rsjax.tools.pipeline.run import Run

METRICS = "metrics.json"  # of the run, and a copy in the saved model, from which play says how far to trust it
BATCH = 16  # clips that are generated at once to measure the loss of half precision
SCORES = ("psnr", "psnr_motion", "delta_psnr", "ssim", "lpips_alex", "depth_absrel", "cube_error_widths")
ROWS = {"": "prediction", "_repeat_first": "first frame repeated", "_tokenizer": "tokenizer's reconstruction"}


@dataclass(frozen=True)
class Publication:
    """The content of a saved model beside its weights.

    Attributes:
        dtype: of the weights.
        clips: the number of held-out clips, spread over the test split.
        measured: the number of held-out clips on which the loss of rounded weights is measured; 0: not at all.
        license: as hubs name it; empty: the card names none.
        note: a paragraph for the top of the card.
    """

    dtype: Dtype = "float16"
    clips: int = 16
    measured: int = 64
    license: str = ""
    note: str = ""


def publish(run: Run, out: Path, what: Publication) -> str:
    """Writes the saved model of a finished run, loads it again, and measures what rounding its weights costs.

    Returns:
        A line with what was measured.

    Raises:
        UserError: the run is unfinished or its clips are missing, or ``out`` holds something else.
    """
    scores = read_json(run.directory / METRICS, cure="the train command of this run makes it")
    starts = read_starts(run.directory)
    if not starts:
        raise UserError(f"{run.directory}: has no run.json, so nothing says what made it; train it with rsjax train")
    trained = load(run.directory)
    store = run.open_clips()
    trained.save(out, what.dtype)
    write_json(out / METRICS, scores)
    numbers = write_excerpt(store, out / CLIPS, what.clips)
    lost = "Nothing was measured with these weights."
    if what.measured:
        lost = loss_of_rounding(trained, load(out), load_clips(store, what.measured), what.dtype)
    sections = [
        what.note,
        f"## Data\n\n{_data(run, store, numbers)}",
        f"## Training\n\n{_training(run, starts, trained)}",
        f"## Scores\n\n{_scores(run, scores)}\n\n{lost}",
        f"## Limits and misuse\n\n{LIMITS}",
    ]
    text = "\n\n".join(filter(None, sections))
    write_file(out / CARD, model_card(trained.config, out.name, text, what.license).encode())
    return lost


def write_excerpt(store: Store, path: Path, count: int) -> list[int]:
    """Writes clips that are spread over a store's test split as a store of their own; returns their numbers."""
    source = store.source("test")
    clips = dict(readable(source, spread(source, count)))
    meta = {name: value for name, value in store.manifest.items() if name not in ("format", "kind", "splits")}
    excerpt = {"store": meta.get("key"), "split": "test", "records": list(clips)}
    meta |= {"key": f"{meta.get('key')}-{len(clips)}-of-test", "excerpt": excerpt}
    write_store(path, "clips", {"test": clips.values()}, meta)
    return list(clips)


def loss_of_rounding(trained: TrainedModel, rounded: TrainedModel, clips: Clips, dtype: Dtype) -> str:
    """Returns a sentence with the mean PSNR of both models' predictions of these clips, and their difference."""
    before = float(predicted_psnr(trained, clips).mean())
    after = float(predicted_psnr(rounded, clips).mean())
    return (
        f"The weights in this directory are {dtype}. On {len(clips.rgb)} of the held-out clips, the mean PSNR of the "
        f"predicted frames is {after:.3f} dB with them and {before:.3f} dB with the run's own: a loss of "
        f"{before - after:.3f} dB."
    )


def predicted_psnr(trained: TrainedModel, clips: Clips) -> Float[np.ndarray, "B P"]:
    """Returns the PSNR of each frame that is predicted from the clips' prompts and actions."""
    past = trained.config.prompt_frames
    scores = []
    for first in range(0, len(clips.rgb), BATCH):
        part = slice(first, first + BATCH)
        inputs = (trained.params, trained.assets, clips.video[part].frames(0, past), clips.actions[part])
        video = trained.model.generate(*inputs, index=clips.index[part])
        scores.append(np.asarray(psnr(clips.rgb[part], video.rgb))[:, past:])
    return np.concatenate(scores)


def _data(run: Run, store: Store, numbers: list[int]) -> str:
    manifest = store.manifest
    counts = store.counts()
    clips = run.config.clips
    text = (
        f"{counts['train']} training clips and {counts['test']} held-out ones of "
        f"{manifest.get('source') or 'an unknown source'}, {clips.frames} frames of {clips.image_size} × "
        f"{clips.image_size} pixels each"
    )
    rate = frame_rate(store.source("test")[0], manifest)
    if rate:
        text += f", {rate:g} frames per second"
    if manifest.get("success_share") is not None:
        text += f"; {manifest['success_share']:.0%} of the episodes end in success".replace("%", " %")
    if run.config.data is None:
        text += f". They were simulated by this project, with seed {run.config.sim.seed}"
    shown = ", ".join(map(str, numbers))
    return f"{text}. Key of the store: `{manifest.get('key')}`. In `{CLIPS}/`: held-out clips {shown}."


def _training(run: Run, starts: list[dict[str, Any]], trained: TrainedModel) -> str:
    last = starts[-1]
    code = last["code"]
    machine = last["machine"]
    changed = ""
    if code.get("dirty"):
        changed = ", with changes that are not in it"
    minutes = [
        f"{stage.replace('_', ' ')} {mark.seconds / 60:.1f} minutes"
        for stage in ("tokenizer", "world_model")
        if (mark := read_mark(run.directory / stage)) is not None
    ]
    counts = [sum(x.size for x in jax.tree.leaves(tree)) / 1e6 for tree in (trained.params, trained.assets.tokenizer)]
    return (
        f"`{last['command']}`, preset `{run.config.name}`, seed {run.config.train.seed}, started {last['time']}; rsjax "
        f"{code['version']}, commit {code.get('revision') or 'unknown'}{changed}; on {machine['cpu_cores']} cores, "
        f"{machine['devices']} × {machine['device_kind']}. {'; '.join(minutes).capitalize()}. The world model has "
        f"{counts[0]:.2f} M parameters, the tokenizer {counts[1]:.2f} M. All settings are in `config.json`."
    )


def _scores(run: Run, scores: dict[str, Any]) -> str:
    known = metrics()
    names = [name for name in SCORES if scores.get(name) is not None]
    lines = [f"| | {' | '.join(known[name].heading for name in names)} |", "|---" * (1 + len(names)) + "|"]
    for suffix, label in ROWS.items():
        cells = []
        for name in names:
            value = scores.get(f"{name}{suffix}")
            if value is None:
                cells.append("")
            else:
                cells.append(f"{value:.{known[name].decimals}f}")
        lines.append(f"| {label} | {' | '.join(cells)} |")
    clips = run.config.clips
    predicted = clips.frames - run.config.prompt_frames
    held_out = min(run.config.eval.clips, clips.test_clips)
    about = f"On {held_out} held-out clips, {predicted} predicted frames each; from `metrics.json` of the run."
    return "\n".join([about, "", *lines])
