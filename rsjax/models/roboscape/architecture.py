"""The architecture of a transformer: its settings, and sizes that follow from the clips and the tokenizer."""

from dataclasses import dataclass, fields, replace
from typing import Literal

from rsjax.config import (
    Config,
    DepthHead,
    RoboScapeConfig,
    SampleConfig,
    SmallDepthBranch,
    TokenModelConfig,
    TransformerConfig,
    require,
)
from rsjax.config.token_model import check_sampling
from rsjax.models.roboscape.departures.integrated_actions import action_inputs
from rsjax.models.roboscape.departures.second_view import SECOND


@dataclass(frozen=True)
class Architecture(TransformerConfig):
    """All settings of the network.

    Attributes:
        frames: positions in time, and the number of frames that temporal attention covers.
        grid: token cells along each side of a frame.
        code_bits: bits of a token, in ``vocabularies`` equal parts.
        action_inputs: numbers per frame that the action encoder reads; 0: no encoder.
        depth: how the network uses depth: in a branch of its own (Eq. 2 and 3), by a second head on the RGB branch, or
            not at all.
        reads_depth: whether a network with a second head reads depth tokens.
        depth_width: channels of the depth branch; 0: as many as RGB's.
        depth_blocks: blocks of the depth branch; 0: as many as RGB's.
        depth_cells: token cells along each side of one of the depth branch's cells.
        motion_head: whether training predicts how tracked points move
            (:mod:`rsjax.models.roboscape.departures.motion_head`).
        state_heads: whether success, height and opening are read from the features
            (:mod:`rsjax.models.roboscape.departures.state_heads`).
        second_view: whether the RGB branch also reads tokens of a second view, and a head on it predicts them
            (:mod:`rsjax.models.roboscape.departures.second_view`).
        one_start: whether all training clips begin where an episode does, with the robot in one place. The network may
            then know by the sums of actions alone where the robot is, so in generation these go on when the window
            moves (:func:`rsjax.models.roboscape.sample.sums_before`).
        feature_dtype: of the features between layers; :func:`rsjax.models.roboscape.transformer.run_transformer` sets
            it, and :func:`rsjax.models.roboscape.sample.written_out`.
    """

    frames: int = 16
    grid: int = 16
    code_bits: int = 18
    vocabularies: int = 2
    action_inputs: int = 28
    depth: Literal["branch", "head", "none"] = "branch"
    reads_depth: bool = True
    depth_width: int = 0
    depth_blocks: int = 0
    depth_cells: int = 1
    motion_head: bool = False
    state_heads: bool = False
    second_view: bool = False
    one_start: bool = False
    feature_dtype: Literal["float32", "bfloat16"] = "float32"

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.grid % self.depth_cells == 0,
            f"model.depth.cells is {self.depth_cells}, which does not divide the {self.grid} cells of a row; change it",
        )

    @classmethod
    def create(cls, config: Config) -> "Architecture":
        """Returns the architecture of a configuration whose model is RoboScape or Genie."""
        model = config.model
        clips = config.clips
        assert isinstance(model, TokenModelConfig)
        depth: Literal["branch", "head", "none"] = "none"
        small = SmallDepthBranch()
        reads_depth = True
        if isinstance(model, RoboScapeConfig):
            if isinstance(model.depth, DepthHead):
                reads_depth = model.depth.feed_back
            if isinstance(model.depth, SmallDepthBranch):
                depth = "branch"
                small = model.depth
            else:
                depth = model.depth.kind
        inputs = 0
        if model.action_encoder != "none":
            inputs = action_inputs(model.departures, clips.action_dim)
        return cls(
            **{field.name: getattr(model, field.name) for field in fields(TransformerConfig)},
            frames=model.frames(clips),
            grid=config.grid,
            code_bits=config.tokenizer.code_bits,
            vocabularies=config.tokenizer.vocabularies,
            action_inputs=inputs,
            depth=depth,
            reads_depth=reads_depth,
            depth_width=small.width,
            depth_blocks=small.blocks,
            depth_cells=small.cells,
            motion_head=model.keypoint_term == "motion",
            state_heads=model.state_heads is not None,
            second_view=config.second_view,
            one_start=config.one_start,
        )

    @property
    def vocabulary_size(self) -> int:
        """Codes per factorised vocabulary: 2^(D/n)."""
        return 2 ** (self.code_bits // self.vocabularies)

    @property
    def modalities(self) -> tuple[str, ...]:
        """Names of what the network predicts."""
        names = ["rgb"]
        if self.depth != "none":
            names.append("depth")
        if self.second_view:
            names.append(SECOND)
        return tuple(names)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the modalities whose tokens the network reads."""
        if self.depth == "head" and not self.reads_depth:
            return tuple(name for name in self.modalities if name != "depth")
        return self.modalities

    @property
    def branches(self) -> tuple[str, ...]:
        """Names of the network's branches, which are the modalities that have blocks of their own."""
        if self.depth == "branch":
            return ("rgb", "depth")
        return ("rgb",)

    def sizes(self, modality: str) -> "Architecture":
        """Returns the architecture with width, heads, blocks and grid of the branch that reads a modality."""
        if modality != "depth":
            return self
        width = self.depth_width or self.width
        return replace(
            self,
            width=width,
            heads=width // self.head_width,
            blocks=self.depth_blocks or self.blocks,
            grid=self.grid // self.depth_cells,
            depth_cells=1,
        )

    @property
    def groups(self) -> int:
        """The number of equal groups of blocks that the network runs in turn; each has at most one block of depth."""
        if self.depth == "branch":
            return self.sizes("depth").blocks
        return self.blocks

    @property
    def more_rgb(self) -> tuple[str, ...]:
        """Names of a group's RGB blocks after its first, which has a depth block beside it."""
        return tuple(f"rgb_{number}" for number in range(1, self.blocks // self.groups))

    @property
    def uncommitted(self) -> int:
        """The number of newest frames that a temporal cache does not contain yet.

        The pass that begins the next frame commits the last one, whose cells are all decided by then. With
        ``whole_frames`` the pass over a frame's masked cells is final.
        """
        return 0 if self.departures.whole_frames else 1

    def generating(self, sample: SampleConfig, depth: bool) -> "Architecture":
        """Returns the network that generates: without its depth head if the same RGB is generated without it.

        That is so if it does not read depth tokens, and the confidence in them does not order the cells.

        Args:
            depth: whether depth is wanted.
        """
        if depth or "depth" in self.inputs or sample.unmask == "greedy":
            return self
        return replace(self, depth="none")

    def check_sampling(self, sample: SampleConfig) -> None:
        """Raises :class:`rsjax.config.ConfigError` if the network does not support these settings."""
        check_sampling(sample, self.frames, self.departures.action_dropout)
