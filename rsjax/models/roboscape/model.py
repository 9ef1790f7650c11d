"""RoboScape: the dual-branch transformer, trained with the physics-informed objective (paper §2.3).

Axes: B clips, T frames, A action dimensions.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from rsjax.clip import Video
from rsjax.config import ClipShape, Config, RoboScapeConfig, TokenizerConfig, TokenModelConfig
from rsjax.data.clips import first_clip, readable, spread
from rsjax.data.codec import Record
from rsjax.data.loader import Arrays, Transform
from rsjax.data.normalization import Normalization, with_sums
from rsjax.data.state_labels import knows_success, missing_labels
from rsjax.data.store import Store, StoreError
from rsjax.devices import divide
from rsjax.models.base import Assets, TeacherForced, WorldModel, implements
from rsjax.models.roboscape import masking, objective, pretrained, records
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.branching import TokenBranching
from rsjax.models.roboscape.departures import state_heads
from rsjax.models.roboscape.departures.action_dropout import dropped_actions
from rsjax.models.roboscape.departures.keep_still import keep_still
from rsjax.models.roboscape.departures.motion_head import MotionHead
from rsjax.models.roboscape.departures.second_view import SECOND, views
from rsjax.models.roboscape.departures.self_conditioning import conditions_itself, previous_frames
from rsjax.models.roboscape.departures.whole_frames import hidden
from rsjax.models.roboscape.flops import forward_flops, motion_head_flops
from rsjax.models.roboscape.imagine import TokenImagination
from rsjax.models.roboscape.objective import Batch
from rsjax.models.roboscape.sample import Decoded, Tokens, encode_prompt, resting_actions, rollout, rollout_from
from rsjax.models.roboscape.teacher_forcing import score_tokens
from rsjax.models.roboscape.transformer import Transformer, empty_cache, run_transformer, run_with_trunk
from rsjax.progress import note
from rsjax.tokenizers.codec import Codec
from rsjax.tokenizers.tokenize import tokenize_store
from rsjax.trainable import Params, StepContext, Term

LABELLED_CLIPS = 100  # training clips whose labels are checked before training


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
        return objective.loss_weights(self.config, self.architecture)

    def init(self, key: Key[Array, ""]) -> Params:
        return Transformer(self.architecture).init_params(key)

    def loss_terms(self, params: Params, batch: Batch, key: Key[Array, ""], context: StepContext) -> dict[str, Term]:
        """Masks the batch, runs the network and returns the terms of the objective (Eq. 4 to 8).

        Clips without depth do not count in the depth term, and all their depth cells are masked.
        """
        arch = self.architecture
        departures = self.config.departures
        targets = {branch: getattr(batch, branch) for branch in arch.modalities}
        corrupted = masking.corrupt(
            self.config.corruption,
            departures.visible_prefix,
            self.prompt_frames,
            arch.code_bits,
            arch.vocabularies,
            key,
            targets,
            batch.index,
        )
        mask = hidden(departures, corrupted.mask)
        no_depth = None if batch.has_depth is None else batch.has_depth == 0
        drop = dropped_actions(departures.action_dropout, key, batch.index)
        options = {"drop_actions": drop, "no_depth": no_depth}
        inputs = (corrupted.tokens, mask, batch.actions)
        previous = None
        if departures.self_conditioning:
            fixed = jax.lax.stop_gradient(params)
            on = conditions_itself(departures, key, context.step)
            first_pass = partial(run_transformer, arch, fixed, *inputs, **options)
            read = {name: corrupted.tokens[name] for name in arch.inputs}
            previous = previous_frames(first_pass, read, arch.code_bits, on, self.prompt_frames)
        trunk = None
        motion: Any = None
        if arch.state_heads or self.config.keypoint_term in ("motion", "feature"):
            logits, _, trunk = run_with_trunk(arch, params, *inputs, previous=previous, **options)
        else:
            logits, _ = run_transformer(arch, params, *inputs, previous=previous, **options)
        if arch.motion_head:
            motion = MotionHead().apply({"params": params["motion_head"]}, trunk)
        terms = objective.loss_terms(self.config, arch, logits, targets, mask, batch, trunk, motion)
        if arch.state_heads:
            assert trunk is not None and batch.state is not None
            state_terms = state_heads.loss_terms(state_heads.outputs(params, trunk), batch.state, batch.weight)
            terms |= {name: state_terms[name] for name in self.config.state_weights}
        return jax.tree.map(lambda x: x.astype("float32"), terms)

    def check_clips(self, clips: Store) -> None:
        """Notes which labels of the state heads training clips lack; their losses leave those clips out."""
        if not self.architecture.state_heads:
            return
        source = clips.source("train")
        records = [record for _, record in readable(source, spread(source, LABELLED_CLIPS))]
        if clips.manifest["kind"] == "clips" and not knows_success(clips):  # tokens have success only where it is known
            records = [record | {"success": None} for record in records]
        for name, count in missing_labels(records).items():
            note(
                f"{clips.path}: {count} of {len(records)} training clips have no label of {name}, as recordings "
                f"have none; model.state_heads learns {name} from the others alone"
            )

    def prepare(self, clips: Store, assets: Assets, folder: Path, max_damaged: float) -> Store:
        """Makes every clip's tokens and stores them next to the clips, for all runs with this tokenizer and shifts."""
        if self.architecture.second_view and SECOND not in first_clip(clips):
            raise StoreError(
                f"{clips.path}: its clips have no second view; simulate them with sim.second_view, or leave it off"
            )
        codec = self._codec(assets)
        shifts = self.config.token_shifts
        return tokenize_store(clips, codec, self.clips.image_size, folder, max_damaged, shifts)

    def transform(self, normalization: Normalization) -> Transform:
        integrate = self.config.departures.integrate_actions
        arch = self.architecture
        return partial(
            records.token_arrays,
            normalization,
            integrate,
            state=arch.state_heads,
            second_view=arch.second_view,
            backwards=self.config.backwards,
        )

    def batch(self, arrays: Arrays) -> Batch:
        return records.token_batch(arrays)

    def example(self, rng: np.random.Generator) -> Record:
        arch = self.architecture
        return records.random_record(rng, self.clips, arch.grid, arch.code_bits, arch.second_view)

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
        """Encodes the prompt, rolls out tokens and decodes them. T may exceed the trained positions."""
        sample = self.config.sample
        arch = self.architecture.generating(sample, depth and bool(prompt.has_depth.any()))
        tokens, has_depth = self._tokens(assets, prompt, arch)
        tokens, inputs = divide((tokens, self._action_inputs(assets, actions)), params)
        key = jax.random.key(sample.seed)
        resting = resting_actions(arch, assets.normalization)
        made = rollout(arch, sample, params, tokens, inputs, key, index=index, no_depth=~has_depth, resting=resting)
        return self._video(assets, made, has_depth & depth, prompt, tokens)

    def plan(
        self,
        params: Params,
        assets: Assets,
        prompt: Video,
        actions: Float[np.ndarray, "N T A"],
        depth: bool = True,
        last: int | None = None,
        past: Float[np.ndarray, "K A"] | None = None,
    ) -> Video:
        """Encodes the prompt once, and continues it under every action sequence.

        Sums of actions go on from ``past`` where all training clips begin where an episode does.

        Raises:
            ValueError: the candidates' actions into the prompt's frames differ.
        """
        sample = self.config.sample
        arch = self.architecture.generating(sample, depth and bool(prompt.has_depth.any()))
        candidates = len(actions)
        seen = prompt.rgb.shape[1]
        if np.any(actions[:, 1:seen] != actions[:1, 1:seen]):
            raise ValueError(f"the candidates' actions differ in rows before {seen}, which led into the one prompt")
        tokens, has_depth = self._tokens(assets, prompt, arch)
        inputs = self._action_inputs(assets, actions)
        resting = resting_actions(arch, assets.normalization)
        if past is not None and resting is not None:
            scaled = assets.normalization.scaled(past) - assets.normalization.scaled(np.zeros_like(past))
            inputs += with_sums(np.zeros(scaled.shape[-1:]), scaled.sum(0))
        encoded = encode_prompt(arch, sample, params, tokens, inputs[:1, :seen], ~has_depth, resting)
        same_draws = jnp.zeros(candidates, jnp.int32)
        key = jax.random.key(sample.seed)
        made = rollout_from(arch, sample, params, encoded, inputs[:, seen:], key, same_draws)
        if last is not None:
            made = {name: grid if name == "state" else grid[:, -last:] for name, grid in made.items()}
        return self._video(assets, made, np.repeat(has_depth & depth, candidates), prompt, tokens)

    def imagine(self, params: Params, assets: Assets, clips: int, depth: bool = True) -> TokenImagination:
        arch = self.architecture.generating(self.config.sample, depth)
        return TokenImagination(self.config, arch, self._codec(assets), params, clips, depth)

    def branching(self, params: Params, assets: Assets, has_depth: bool, lanes: int = 1) -> TokenBranching:
        arch = self.architecture.generating(self.config.sample, has_depth)
        return TokenBranching(self.config, arch, self._codec(assets), params, has_depth, lanes)

    def reconstruct(self, assets: Assets, video: Video) -> Video:
        codec = self._codec(assets)
        return codec.decode(codec.encode(video), video.has_depth)

    def teacher_forced(
        self, params: Params, assets: Assets, video: Video, actions: Float[np.ndarray, "B T A"], prompt_frames: int = 1
    ) -> TeacherForced:
        """Predicts each frame from the true frames before it. T may exceed the trained positions."""
        arch = self.architecture
        tokens, has_depth = self._tokens(assets, video, arch)
        if "depth" in arch.modalities and "depth" not in tokens:
            tokens["depth"] = jnp.zeros_like(tokens["rgb"])
        tokens, inputs = divide((tokens, self._action_inputs(assets, actions)), params)
        sample = self.config.sample
        resting = resting_actions(arch, assets.normalization)
        return score_tokens(arch, sample, params, tokens, inputs, ~has_depth, prompt_frames, resting)

    def pretrained_shapes(self, directory: Path) -> Params:
        return pretrained.shapes(self.architecture, directory)

    def start(self, fresh: Params, saved: Params, directory: Path) -> Params:
        return pretrained.start(fresh, saved, directory)

    def cache_shapes(self, frames: int) -> Any:
        return jax.eval_shape(lambda: empty_cache(self.architecture, 1, min(frames, self.architecture.frames)))

    def flops(self, frames: int) -> dict[str, int]:
        forward = forward_flops(self.architecture, frames)
        return {"forward": forward, "train": 3 * (forward + motion_head_flops(self.architecture, frames))}

    def _codec(self, assets: Assets) -> Codec:
        assert assets.tokenizer is not None
        return Codec(self.tokenizer, assets.tokenizer, assets.normalization)

    def _video(
        self, assets: Assets, made: Decoded, has_depth: Bool[np.ndarray, " B"], prompt: Video, tokens: Tokens
    ) -> Video:
        """Returns the video that a rollout from this prompt and its tokens makes, with what the state heads read."""
        codec = self._codec(assets)
        video = codec.decode(made, has_depth)
        still = self.config.sample.keep_still
        if still is not None:
            reconstructed = codec.decode_rgb(np.asarray(tokens["rgb"][:, -1]))
            token = self.tokenizer.downsampling
            video = replace(video, rgb=keep_still(still, token, video.rgb, prompt.rgb[:, -1], reconstructed))
        if "state" not in made:
            return video
        return replace(video, state=np.asarray(made["state"]))

    def _tokens(self, assets: Assets, video: Video, arch: Architecture) -> tuple[Tokens, np.ndarray]:
        """Returns a video's tokens by branch (depth if network and a clip have it), and which clips have depth."""
        inputs = views(video, arch.depth != "none", arch.second_view)
        tokens = self._codec(assets).encode(inputs)
        return {branch: jnp.asarray(grid) for branch, grid in tokens.items()}, inputs.has_depth

    def _action_inputs(self, assets: Assets, actions: Float[np.ndarray, "B T A"]) -> Float[Array, "B T A2"]:
        """Returns what the action encoder reads."""
        return jnp.asarray(assets.normalization.action_inputs(actions, self.config.departures.integrate_actions))
