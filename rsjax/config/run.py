"""Settings of sampling and evaluation, and the whole of a run."""

from dataclasses import dataclass, replace
from typing import Any, Literal

from rsjax.config.data import ClipShape, DataConfig
from rsjax.config.fields import require
from rsjax.config.model import LossConfig, MaskConfig, ModelConfig
from rsjax.config.sim import SimConfig
from rsjax.config.tokenizer import TokenizerConfig, TokenizerTrainConfig
from rsjax.config.train import LoopConfig


@dataclass(frozen=True)
class SampleConfig:
    """MaskGIT decoding within a frame, and what is remembered from frame to frame."""

    steps: int = 2
    temperature: float = 0.0  # logits are divided by it; 0 takes the most probable code
    top_k: int = 0  # draw among each vocabulary's this many most probable codes; 0: among all
    unmask: Literal["random", "greedy"] = "random"  # greedy tends to copy the frame before
    # g of logits = without + g·(with - without the actions). 1: the model as it is. Others need model.action_dropout
    # and two passes in one.
    guidance: float = 1.0
    # Learned positions only: when model.frames are full, the first window_stride drop out and the rest are encoded anew
    # from position 0. Fewer: a longer memory and more work. 0: half of model.frames.
    window_stride: int = 0
    cache_dtype: Literal["float32", "bfloat16"] = "float32"  # of temporal keys and values; bfloat16 halves the memory
    seed: int = 0

    def __post_init__(self) -> None:
        require(self.steps >= 1, f"sample.steps is {self.steps}; a frame needs at least 1 decoding step")
        for name in ("temperature", "top_k", "window_stride"):
            require(getattr(self, name) >= 0, f"sample.{name} is {getattr(self, name)}; it cannot be negative")

    def check(self, model: ModelConfig) -> None:
        """Raises :class:`rsjax.config.ConfigError` where ``model`` cannot be sampled like this."""
        require(
            self.guidance == 1 or model.action_dropout > 0,
            f"sample.guidance is {self.guidance} but the model never saw clips without actions; "
            f"set it to 1, or train with model.action_dropout above 0",
        )
        require(
            self.window_stride < model.frames,
            f"sample.window_stride is {self.window_stride} of model.frames = {model.frames}; "
            f"at least one frame must stay in the window",
        )


@dataclass(frozen=True)
class EvalConfig:
    """Evaluation on held-out clips."""

    clips: int = 20  # spread evenly over the test split
    loss_clips: int = 1000  # of the test split, likewise, over which the loss is taken while training
    batch_size: int = 10
    action_draws: int = 3  # random action sequences per clip and kind, for ΔPSNR
    report_clips: int = 4  # clips shown in the report

    def __post_init__(self) -> None:
        for name in ("loss_clips", "batch_size", "action_draws", "report_clips"):
            require(getattr(self, name) > 0, f"eval.{name} is {getattr(self, name)}; it must be positive")


@dataclass(frozen=True)
class Config:
    """One run. Built from a preset; never changed while it runs."""

    name: str
    sim: SimConfig = SimConfig()  # not looked at where data names a store
    data: DataConfig = DataConfig()
    tokenizer: TokenizerConfig = TokenizerConfig()
    tokenizer_train: TokenizerTrainConfig = TokenizerTrainConfig()
    model: ModelConfig = ModelConfig()
    mask: MaskConfig = MaskConfig()
    loss: LossConfig = LossConfig()
    train: LoopConfig = LoopConfig()
    sample: SampleConfig = SampleConfig()
    eval: EvalConfig = EvalConfig()

    def __post_init__(self) -> None:
        clips, at = self.clips, "data" if self.data.key else "sim"
        require(
            clips.frames <= self.model.frames,
            f"{at}.frames is {clips.frames} but model.frames holds positions for {self.model.frames}; "
            f"shorten the clips or enlarge model.frames",
        )
        require(
            self.mask.prompt_frames < clips.frames,
            f"mask.prompt_frames is {self.mask.prompt_frames} of {clips.frames} frames; "
            f"at least one frame must be left to predict",
        )
        test_clips = "data.test_clips" if self.data.key else "sim.test_episodes"
        require(
            min(self.eval.clips, clips.test_clips) >= 2,
            f"eval.clips is {self.eval.clips} of {test_clips} {clips.test_clips}; both must be at least 2, "
            f"so that a clip can be generated under another one's actions",
        )
        self.sample.check(self.model)
        pairs = [
            (f"{at}.image_size", clips.image_size, "tokenizer.image_size", self.tokenizer.image_size),
            ("tokenizer grid", self.tokenizer.grid, "model.grid", self.model.grid),
            ("tokenizer.code_bits", self.tokenizer.code_bits, "model.code_bits", self.model.code_bits),
            ("tokenizer.vocabularies", self.tokenizer.vocabularies, "model.vocabularies", self.model.vocabularies),
        ]
        if self.model.action_dim:
            pairs.append(
                ("what the action encoder sees", self.action_inputs, "model.action_dim", self.model.action_dim)
            )
        for left, left_value, right, right_value in pairs:
            require(left_value == right_value, f"{left} is {left_value} but {right} is {right_value}; make them equal")
        require(
            not self.loss.keypoints or self.loss.num_keypoints <= clips.tracks,
            f"loss.num_keypoints is {self.loss.num_keypoints} but only {at}.tracks = {clips.tracks} are tracked",
        )

    def with_loops(self, **changes: Any) -> "Config":
        """This configuration with fields of both training loops set."""
        tokenizer_train = replace(self.tokenizer_train, **changes)
        return replace(self, train=replace(self.train, **changes), tokenizer_train=tokenizer_train)

    @property
    def clips(self) -> ClipShape:
        """What the clips are like that the run learns from."""
        return self.data.clips if self.data.key else self.sim.clips

    @property
    def action_inputs(self) -> int:
        """Width of what the action encoder sees: that of a frame's action, and as much again for sums if given."""
        return self.clips.action_dim * (2 if self.model.integrate_actions else 1)
