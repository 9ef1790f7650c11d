"""RoboScape: the physics-informed objective on the dual-branch transformer (paper Eq. 4–8).

A loss term is one function here, registered by :func:`loss_term`, and one weight in :class:`rsjax.config.LossConfig`.

Axes: B clips, T frames, H×W = S cells, n vocabularies of V codes, D code bits, K keypoints, A action dimensions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from rsjax.clip import Video
from rsjax.config import ClipShape, Config, LossConfig, RoboScapeConfig, TokenizerConfig, TokenModelConfig
from rsjax.data.codec import Record
from rsjax.data.normalization import Normalization
from rsjax.data.order import Arrays, Transform
from rsjax.data.store import Store
from rsjax.models.base import Assets, TeacherForced, WorldModel, implements
from rsjax.models.roboscape import masking, pretrained, records
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.branching import TokenBranching
from rsjax.models.roboscape.flops import forward_flops
from rsjax.models.roboscape.generate import generate, plan, teacher_forced
from rsjax.models.roboscape.imagine import Imagined
from rsjax.models.roboscape.keypoints import Keypoints, attention_map, counted_frames, select
from rsjax.models.roboscape.records import Batch
from rsjax.models.roboscape.self_conditioning import previous_frames
from rsjax.models.roboscape.transformer import Transformer, empty_cache, hidden
from rsjax.tokenizers import lfq
from rsjax.tokenizers.codec import Codec
from rsjax.tokenizers.tokenize import tokenize_store
from rsjax.trainable import Params, StepContext, Term


@dataclass(frozen=True)
class Predictions:
    """Inputs of the loss terms.

    Attributes:
        model: the model, for its settings.
        logits: (B, T, S, n, V) by branch.
        clean: the target tokens, (B, T, H, W) by branch.
        mask: the masked cells.
        batch: the clips.
    """

    model: "RoboScape"
    logits: dict[str, Float[Array, "B T S n V"]]
    clean: dict[str, Int[Array, "B T H W"]]
    mask: Bool[Array, "B T H W"]
    batch: Batch

    @cached_property
    def cross_entropy(self) -> dict[str, Float[Array, "B T H W"]]:
        """-log p of each cell's target by branch, in nats."""
        bits = self.model.architecture.code_bits
        return {branch: lfq.token_cross_entropy(self.logits[branch], self.clean[branch], bits) for branch in self.clean}

    @cached_property
    def keypoints(self) -> Keypoints:
        """The K tracks that move most, on the token grid."""
        loss, tracks = self.model.loss, self.batch.tracks
        count = min(loss.num_keypoints, tracks.shape[1])
        counted = counted_frames(self.model.config.departures, self.batch.visible)
        return select(tracks, counted, count, self.model.architecture.grid)


TERMS: dict[str, Callable[[Predictions], Term]] = {}


def loss_term(name: str) -> Callable[[Callable[[Predictions], Term]], Callable[[Predictions], Term]]:
    """Registers a function as the loss term that ``LossConfig.NAME_weight`` weighs."""

    def register(function: Callable[[Predictions], Term]) -> Callable[[Predictions], Term]:
        TERMS[name] = function
        return function

    return register


@loss_term("rgb")
def rgb_term(of: Predictions) -> Term:
    """Returns L_RGB of Eq. 4: cross-entropy of the RGB tokens over the masked cells."""
    weight = of.mask * of.batch.weight[:, None, None, None]
    return jnp.sum(of.cross_entropy["rgb"] * weight), jnp.sum(weight)


@loss_term("depth")
def depth_term(of: Predictions) -> Term:
    """Returns L_Depth of Eq. 4: the same for the depth tokens of clips with depth; (0, 0) if none has depth."""
    has_depth = of.batch.has_depth
    clips = of.batch.weight if has_depth is None else of.batch.weight * has_depth
    weight = of.mask * clips[:, None, None, None]
    return jnp.sum(of.cross_entropy["depth"] * weight), jnp.sum(weight)


@loss_term("attention")
def attention_term(of: Predictions) -> Term:
    """Returns L_Attention of Eq. 7: cross-entropy of the RGB tokens, weighted by the map of Eq. 6.

    The sum is divided by the number of masked cells, not by the sum of the map.
    """
    attention = attention_map(of.keypoints, of.model.architecture.grid, of.model.loss.gamma)
    weight = of.mask * of.batch.weight[:, None, None, None]
    return jnp.sum(of.cross_entropy["rgb"] * attention * weight), jnp.sum(weight)


@loss_term("keypoint")
def keypoint_term(of: Predictions) -> Term:
    """Returns L_Keypoint of Eq. 5: ‖ŝ_t(p_i^t) - ŝ_1(p_i^1)‖² over keypoints i and frames t ≥ 2.

    The departure ``observed_anchor`` uses the true code instead of ŝ_1; ``masked_keypoints`` leaves out keypoints on
    cells that are not masked.
    """
    bits = of.model.architecture.code_bits
    departures = of.model.config.departures
    cells = of.keypoints.cells.swapaxes(1, 2)  # B T K

    def at_points(codes: Float[Array, "B t S D"], cells: Int[Array, "B t K"]) -> Float[Array, "B t K D"]:
        return jnp.take_along_axis(codes, cells[..., None], axis=2)

    predicted = lfq.mean_codes(of.logits["rgb"], bits)  # B T S D
    if departures.observed_anchor:
        first = lfq.tokens_to_codes(of.clean["rgb"][:, :1], bits)
        anchor = at_points(first.reshape(predicted[:, :1].shape), cells[:, :1])
    else:
        anchor = at_points(predicted[:, :1], cells[:, :1])
    distance = jnp.sum(jnp.square(at_points(predicted[:, 1:], cells[:, 1:]) - anchor), axis=-1)
    weight = of.keypoints.visible.swapaxes(1, 2)[:, 1:] * of.batch.weight[:, None, None]
    if departures.masked_keypoints:
        mask = of.mask.reshape(*of.mask.shape[:2], -1)  # B T S
        weight = weight * jnp.take_along_axis(mask[:, 1:], cells[:, 1:], axis=2)
    return jnp.sum(distance * weight), jnp.sum(weight)


@implements(RoboScapeConfig)
@dataclass(frozen=True)
class RoboScape(WorldModel[Batch]):
    """The dual-branch co-autoregressive transformer on the tokens of RGB frames and depth maps.

    Attributes:
        config: the family's settings.
        architecture: the network's settings.
        prompt_frames: frames that generation starts from; corruption in training leaves them alone.
        tokenizer: settings of the tokenizer.
        clips: the shape of the training clips.
    """

    config: TokenModelConfig
    architecture: Architecture
    prompt_frames: int
    tokenizer: TokenizerConfig
    clips: ClipShape

    @classmethod
    def create(cls, config: Config) -> "RoboScape":
        assert isinstance(config.model, TokenModelConfig)
        return cls(config.model, Architecture.create(config), config.prompt_frames, config.tokenizer, config.clips)

    @property
    def loss_weights(self) -> dict[str, float]:
        return self.config.loss_weights

    @property
    def loss(self) -> LossConfig:
        """Settings of the keypoint terms."""
        assert isinstance(self.config, RoboScapeConfig)
        return self.config.loss

    def init(self, key: Key[Array, ""]) -> Params:
        return Transformer(self.architecture).init_params(key)

    def loss_terms(self, params: Params, batch: Batch, key: Key[Array, ""], context: StepContext) -> dict[str, Term]:
        """Masks the batch, runs the network and computes the active terms.

        Clips without depth do not count in the depth term, and all their depth cells are masked.
        """
        arch = self.architecture
        clean = {branch: getattr(batch, branch) for branch in arch.branches}
        shape = (self.prompt_frames, arch.code_bits, arch.vocabularies)
        masked = masking.corrupt(
            self.config.mask, self.config.departures.visible_prefix, *shape, key, clean, batch.index
        )
        drop = (
            masking.dropped_actions(arch.departures.action_dropout, key, batch.index)
            if arch.departures.action_dropout
            else None
        )
        no_depth = None if batch.has_depth is None else batch.has_depth == 0
        mask = hidden(arch, masked.mask)
        inputs = (masked.tokens, mask, batch.actions)
        apply = partial(Transformer(arch).apply, drop_actions=drop, no_depth=no_depth)
        previous = None
        if self.config.departures.self_conditioning:
            own = masking.reads_own_frames(self.config.departures, key, context.step)
            fixed = {"params": jax.lax.stop_gradient(params)}
            predict = lambda: apply(fixed, *inputs)[0]  # noqa: E731
            previous = previous_frames(predict, masked.tokens, arch.code_bits, own, self.prompt_frames)
        logits, _ = apply({"params": params}, *inputs, previous=previous)
        predictions = Predictions(self, logits, clean, mask, batch)
        terms = {name: TERMS[name](predictions) for name in TERMS if name in self.loss_weights}
        return jax.tree.map(lambda x: x.astype("float32"), terms)

    def prepare(self, clips: Store, assets: Assets, folder: Path, max_damaged: float) -> Store:
        """Makes every clip's tokens and stores them next to the clips, for all runs with this tokenizer and shifts."""
        codec, shifts = self._codec(assets), self.config.token_shifts
        return tokenize_store(clips, codec, self.clips.image_size, folder, max_damaged, shifts)

    def transform(self, normalization: Normalization) -> Transform:
        return partial(records.token_arrays, normalization, self.config.departures.integrate_actions)

    def batch(self, arrays: Arrays) -> Batch:
        return records.token_batch(arrays)

    def example(self, rng: np.random.Generator) -> Record:
        arch = self.architecture
        return records.random_record(rng, self.clips, arch.grid, arch.code_bits)

    def generate(
        self,
        params: Params,
        assets: Assets,
        prompt: Video,
        actions: Float[np.ndarray, "B T A"],
        *,
        index: Int[np.ndarray, " B"] | None = None,
        depth: bool = True,
    ) -> Video:
        return generate(self.config, self.architecture, self._codec(assets), params, prompt, actions, index, depth)

    def plan(
        self,
        params: Params,
        assets: Assets,
        prompt: Video,
        actions: Float[np.ndarray, "N T A"],
        depth: bool = True,
        last: int | None = None,
    ) -> Video:
        return plan(self.config, self.architecture, self._codec(assets), params, prompt, actions, depth, last)

    def imagine(self, params: Params, assets: Assets, clips: int) -> Imagined:
        return Imagined(self.config, self.architecture, self._codec(assets), params, clips)

    def branching(self, params: Params, assets: Assets, has_depth: bool, lanes: int = 1) -> TokenBranching:
        codec = self._codec(assets)
        return TokenBranching(self.config, self.architecture, codec, params, has_depth, lanes)

    def reconstruct(self, assets: Assets, video: Video) -> Video:
        codec = self._codec(assets)
        return codec.decode(codec.encode(video), video.has_depth)

    def teacher_forced(
        self, params: Params, assets: Assets, video: Video, actions: Float[np.ndarray, "B T A"], prompt_frames: int = 1
    ) -> TeacherForced:
        inputs = (params, video, actions, prompt_frames)
        return teacher_forced(self.config, self.architecture, self._codec(assets), *inputs)

    def pretrained_shapes(self, directory: Path) -> Params:
        return pretrained.shapes(self.architecture, directory)

    def start(self, fresh: Params, saved: Params, directory: Path) -> Params:
        return pretrained.start(fresh, saved, directory)

    def cache_shapes(self, frames: int) -> Any:
        return jax.eval_shape(lambda: empty_cache(self.architecture, 1, min(frames, self.architecture.frames)))

    def flops(self, frames: int) -> dict[str, int]:
        forward = forward_flops(self.architecture, frames)
        return {"forward": forward, "train": 3 * forward}

    def _codec(self, assets: Assets) -> Codec:
        assert assets.tokenizer is not None
        return Codec(self.tokenizer, assets.tokenizer, assets.normalization)
