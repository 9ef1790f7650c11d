"""Determines how large the cells of a budget are, and estimates how long they take.

The constants were measured with ``tiny`` on 2 cores of an AMD EPYC on 2026-11-22. The sizes depend only on the budget
and these constants, not on the machine at hand. So the same budget always means the same cells, and a command that is
started again finds them.
"""

import re
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any, Literal

import jax

from rsjax.config import SIMULATOR, Config, SmallDepthBranch, TokenizerConfig, TokenModelConfig, TrainConfig, require
from rsjax.config.config_fields import with_values
from rsjax.evaluation.depth_network import BATCH
from rsjax.models.base import create_autoencoder, create_model
from rsjax.tokenizers.autoencoder import Autoencoder
from rsjax.tokenizers.flops import tokenizer_flops
from rsjax.tools.pipeline.estimated_annotations import CLIPS, PASSES

EPISODE = 0.41  # seconds to simulate an episode
TOKENS = 1 / 26  # seconds to make the tokens of a clip or of a moved copy of it
STEP = 0.06  # fixed seconds of a world model's step
RATE = 1.4e11  # operations per second of the rest of the step
# A narrow depth branch, or one at coarser cells, takes longer than its operations say: by this share of a step without
# depth. With it, estimated steps are within 8 % of those measured in docs/depth.md.
SMALL_BRANCH = 0.15
# Operations per second of the tokenizer's training, with Muon: 4.1e10 in float32; a step in bf16 takes 0.89 × the time.
TOKENIZER_RATE = 4.6e10
START = 15.0  # seconds until a training's first step: 27 for the first training with its shapes, 9 for the next
# Seconds of a step of autoencoder and model in a family's small preset, on the idle machine; of other families' steps,
# the operations tell the seconds.
FAMILY_STEPS = {"irasim": (0.13, 0.34), "cogvideox": (0.85, 0.50), "ivideogpt": (0.88, 1.02)}
# Seconds by which an imagined episode of Lift takes longer than a simulated one, on 2 cores of an Intel Ice Lake: each
# of its 30 frames takes these families a whole video.
FAMILY_EPISODES = {"irasim": 29.0, "ivideogpt": 3.4}
# Seconds of a generated clip of 16 frames, by the seconds a frame of docs/results/baselines.md; 0.08 for others.
FAMILY_VIDEOS = {"irasim": 0.30, "ivideogpt": 0.32}
VIDEO = 0.08
EVALUATION = 30.0  # seconds per evaluation
LOCALISER = 0.106  # seconds per step of the localiser
# Seconds per step of the depth estimator that learns from the clips, for frames of 64 pixels: 0.126 of processor time.
DEPTH_STEP = 0.08
FOLLOW = 0.014  # seconds of processor time to follow the points of a clip of 64 pixels by Lucas–Kanade
ROLLOUT = 0.18  # seconds per rollout

COLLECT_SHARE = 0.06  # shares of a budget
TOKENIZER_SHARE = 0.08
DEPTH_SHARE = 0.02
SPENT_IN_CELLS = 0.85
ROLLOUTS_SHARE = 0.12  # shares of a cell
LOCALISER_SHARE = 0.04
# The number of trainings of the base preset that a budget of half an hour is divided into (those of Tables 1 and 2 with
# three seeds, six of which are cheaper because they are without depth), and how it grows with the budget.
CELLS = 13.7
GROWTH = 0.4
LEAST_STEPS = 40
LEAST_TOKENIZER_STEPS = 100
LEAST_EPISODES = 60
LEAST_CLIPS = 2
SEEDS = 3
_UNITS = {"s": 1, "sec": 1, "min": 60, "m": 60, "h": 3600, "d": 86400}
_TERM = re.compile(r"(\d+(?:\.\d+)?)\s*(" + "|".join(sorted(_UNITS, key=len, reverse=True)) + r")\s*")
HOUR = 3600.0
VARY_EVERYTHING = 12 * HOUR  # from this budget on, where clips and tokenizers of each seed take little of it


MOST_SECONDS = 366 * 86400


def parse_duration(text: str, option: str = "--budget") -> float:
    """Returns the seconds of a duration such as ``30min``, ``3h`` or ``1h30min``.

    Args:
        option: where it was given, for the error.

    Raises:
        ConfigError: the text is not a duration above 0.
    """
    text = text.strip()
    terms = list(_TERM.finditer(text))
    seconds = sum(float(term[1]) * _UNITS[term[2]] for term in terms)
    whole = "".join(term[0] for term in terms) == text
    require(whole and seconds > 0, f"{option} {text:.80}: not a duration; write 30min, 3h, 12h or 1h30min")
    require(seconds <= MOST_SECONDS, f"{option} {text:.80}: longer than {MOST_SECONDS // 86400} days")
    return seconds


@dataclass(frozen=True)
class Scale:
    """The sizes of all cells of a budget.

    Attributes:
        seconds: the budget.
        base: the base preset at this size.
    """

    seconds: float
    base: Config


def scale(preset: Config, seconds: float) -> Scale:
    """Returns the preset with as many episodes, steps and scored clips as the budget allows, at most its own."""
    sim = preset.sim
    tokenizer = preset.tokenizer_train
    evaluation = preset.eval
    each = SPENT_IN_CELLS * seconds / (CELLS * (seconds / (HOUR / 2)) ** GROWTH)
    episodes = min(sim.episodes, max(LEAST_EPISODES, _round(COLLECT_SHARE * seconds / EPISODE)))
    rollouts = ROLLOUTS_SHARE * each / ROLLOUT
    # Small budgets allow for one draw of random actions when they size a cell. The preset's further draws come on top,
    # in the estimate of every evaluation, so that fewer trainings fit, but none is shorter.
    draws = evaluation.action_draws
    sized_for = draws if rollouts >= evaluation.clips * (1 + 2 * draws) else 1
    clips = max(LEAST_CLIPS, min(_round(rollouts / (1 + 2 * sized_for)), episodes // 6))
    clips = min(evaluation.clips, sim.test_episodes, clips)
    per_step = tokenizer_step_seconds(preset)
    tokenizer_steps = min(tokenizer.steps, max(LEAST_TOKENIZER_STEPS, _round(TOKENIZER_SHARE * seconds / per_step)))
    values = {
        "sim.episodes": episodes,
        "sim.test_episodes": clips,
        "tokenizer_train.steps": tokenizer_steps,
        "eval.clips": clips,
        "eval.batch_size": min(evaluation.batch_size, clips),
        "eval.action_draws": draws,
        "eval.localiser_steps": min(evaluation.localiser_steps, max(1, _round(LOCALISER_SHARE * each / LOCALISER))),
        "train.curriculum": (),  # its epochs would determine the steps; a claim's arms have their own
        "runtime.eval_every": 0,
    }
    if evaluation.simulator_steps:
        depth_steps = max(1, _round(DEPTH_SHARE * seconds / _depth_step_seconds(preset)))
        values["eval.depth_estimator"] = f"{SIMULATOR}:steps={min(evaluation.simulator_steps, depth_steps)}"
    base = with_values(preset, values)
    steps = (each - START - evaluation_seconds(base, sized_for)) / step_seconds(base)
    base = with_steps(base, min(preset.train.steps, max(LEAST_STEPS, _round(steps))))
    return Scale(seconds, base)


def with_steps(config: Config, steps: int) -> Config:
    """Returns the configuration with a number of world-model steps; own frames begin at the same share of the steps."""
    values = {"train.steps": steps}
    if isinstance(config.model, TokenModelConfig):
        values["model.departures.self_conditioning_after"] = (
            config.model.departures.self_conditioning_after * steps // config.train.steps
        )
    return with_values(config, values)


def _round(number: float) -> int:
    """Rounds to two digits, so that sizes are readable."""
    return int(float(f"{max(number, 0):.2g}"))


def cut(config: Config, share: float) -> Config:
    """Returns the configuration with each training cut to a share of its steps, at least one, without validations."""
    loops = {
        field.name: replace(loop, steps=max(1, round(share * loop.steps)))
        for field in fields(config)
        if isinstance(loop := getattr(config, field.name), TrainConfig)
    }
    return replace(config, **loops, runtime=replace(config.runtime, eval_every=0))  # type: ignore[arg-type]


def train_flops(config: Config) -> int | None:
    """Returns the operations of the world model's whole training; None for a family that does not count them."""
    per_clip = create_model(config).flops(config.clips.frames).get("train")
    if per_clip is None:
        return None
    # A step on own frames needs one more forward pass, a third of a step. It is counted from the first step on.
    own = config.model.departures.self_conditioning / 3 if isinstance(config.model, TokenModelConfig) else 0.0
    return round(config.train.steps * config.train.batch_size * per_clip * (1 + own))


@cache
def parameters(config: Config) -> tuple[int, int]:
    """Returns the numbers of parameters of the world model and of its autoencoder."""
    model = jax.eval_shape(create_model(config).init, jax.random.key(0))
    autoencoder = create_autoencoder(config).shapes() if config.model.uses_tokenizer else {}
    return tuple(sum(x.size for x in jax.tree.leaves(shapes)) for shapes in (model, autoencoder))  # type: ignore[return-value]


def step_seconds(config: Config) -> float:
    """Returns the seconds of a step of the world model; 0 for a family that does not count its operations."""
    if config.model.family in FAMILY_STEPS:
        return FAMILY_STEPS[config.model.family][1]
    flops = train_flops(config)
    if flops is None:
        return 0.0
    seconds = STEP + flops / max(1, config.train.steps) / RATE
    depth = getattr(config.model, "depth", None)
    if isinstance(depth, SmallDepthBranch) and (depth.width or depth.cells > 1):
        seconds += SMALL_BRANCH * step_seconds(with_values(config, {"model.depth": "none"}))
    return seconds


def tokenizer_step_seconds(config: Config) -> float:
    """Returns the seconds of a step of the tokenizer."""
    if config.model.family in FAMILY_STEPS:
        return FAMILY_STEPS[config.model.family][0]
    loop = config.tokenizer_train
    flops = _image_flops(config.tokenizer, config.clips.image_size)
    return 3 * loop.batch_size * loop.frames_per_clip * flops / TOKENIZER_RATE


@cache
def _image_flops(tokenizer: TokenizerConfig, image_size: int) -> int:
    return sum(tokenizer_flops(tokenizer, image_size).values())


def collect_seconds(config: Config) -> float:
    """Returns the seconds of the simulation."""
    return 0.0 if config.data is not None else EPISODE * config.sim.episodes


def depth_estimator_seconds(config: Config) -> float:
    """Returns the seconds of training the depth estimator; 0 if none learns from the clips."""
    steps = config.eval.simulator_steps
    return START + steps * _depth_step_seconds(config) if steps else 0.0


def annotation_seconds(config: Config) -> float:
    """Returns the seconds of estimating training clips' depth and tracks, and of making tokens; 0 if none are read."""
    wanted = {part.annotations for stage in config.train.curriculum for part in stage.components} - {"own"}
    clips = config.sim.episodes - config.sim.test_episodes
    seconds = TOKENS * config.sim.episodes * (1 + sum(config.model.token_shifts[:1])) * len(wanted)
    if wanted & {"estimated_depth", "estimated"}:
        steps = PASSES * min(clips, 2 * CLIPS) * config.clips.frames / BATCH  # of both halves' networks
        seconds += 2 * START + steps * _depth_step_seconds(config)
    if wanted & {"estimated_tracks", "estimated"}:
        seconds += FOLLOW * clips
    return seconds


def _depth_step_seconds(config: Config) -> float:
    return DEPTH_STEP * (config.clips.image_size / 64) ** 2


def tokenizer_seconds(config: Config) -> float:
    """Returns the seconds of training the tokenizer or autoencoder and of making tokens."""
    if not config.model.uses_tokenizer:
        return 0.0
    clips = config.sim.episodes * (1 + sum(config.model.token_shifts[:1]))
    return START + config.tokenizer_train.steps * tokenizer_step_seconds(config) + TOKENS * clips


def training_cost(config: Config, unit: Literal["seconds", "flops"]) -> tuple[float, float]:
    """Returns the cost of training the autoencoder and the world model, in estimated seconds or in operations."""
    loop = config.tokenizer_train
    if unit == "seconds":
        return loop.steps * tokenizer_step_seconds(config), config.train.steps * step_seconds(config)
    images = loop.steps * loop.batch_size * loop.frames_per_clip
    if not config.model.uses_tokenizer:
        return 0.0, float(train_flops(config) or 0)
    # Leave out what differs between arms and budgets: some families count by tracing programs, and this is cached.
    autoencoder = create_autoencoder(replace(config, tokenizer_train=replace(loop, steps=1)))
    flops = _frame_flops(autoencoder)  # type: ignore[arg-type]  # a frozen dataclass, so it can be hashed
    return 3.0 * images * flops, float(train_flops(config) or 0)


@cache
def _frame_flops(autoencoder: Autoencoder[Any]) -> int:
    """Returns the operations of encoding and decoding a frame."""
    return sum(autoencoder.flops().values())


def evaluation_seconds(config: Config, draws: int | None = None, frames: int = 0) -> float:
    """Returns the seconds of an evaluation and a report.

    Args:
        draws: draws of random actions; None: the configuration's number.
        frames: frames per rollout; 0: the clips' number.
    """
    draws = config.eval.action_draws if draws is None else draws
    draws = draws if config.model.takes_actions else 0
    rollouts = config.eval.clips * (1 + 2 * draws) * (frames or config.clips.frames) / config.clips.frames
    return EVALUATION + LOCALISER * config.eval.localiser_steps + ROLLOUT * rollouts


def model_seconds(config: Config) -> float:
    """Returns the seconds of the world model's training."""
    return START + training_cost(config, "seconds")[1]
