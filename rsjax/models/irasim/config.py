"""Settings of IRASim, a diffusion transformer on the latents of a clip's frames."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

from rsjax.config.data import ClipShape
from rsjax.config.fields import ConfigError, loss_weights, require, require_range, runtime, sampling
from rsjax.config.model import ModelConfig, register_family
from rsjax.config.tokenizer import TokenizerConfig
from rsjax.models.diffusion.config import DenoiseConfig, NoiseConfig, check_grid


@dataclass(frozen=True)
class DiTConfig:
    """A diffusion transformer on frames: blocks within frames alternate with blocks over time."""

    # frame: each action modulates the blocks within its frame (the paper's Frame-Ada). video: all actions together
    # modulate every block (Video-Ada).
    conditioning: Literal["frame", "video"] = "frame"
    # Between the two linear layers of the action encoder; none: as in the public models of Language-Table. Its
    # Video-Ada encodes each action by them, and all of a clip by an MLP that follows.
    action_activation: Literal["gelu", "none"] = "gelu"
    final_frame_ada: bool = False  # frame: actions modulate the last layer, too; the published weights lack it
    learn_sigma: bool = False  # outputs variances beside the noise; they are neither trained nor read
    integrate_actions: bool = False  # also the sum of all actions so far; see TransformerConfig
    width: int = 1152  # channels of the transformer
    blocks: int = 28  # half of them within frames, half over time
    heads: int = 16  # of each attention; the width is theirs together
    mlp_ratio: int = 4  # width of an MLP's hidden layer, in widths of the model
    patch_size: int = 2  # cells of latents that one token covers, along each side
    compute_dtype: Literal["float32", "bfloat16"] = "float32"  # bfloat16: operands of linear layers and attention
    unroll: int = runtime(1)  # pairs of blocks per iteration of the scan; more are faster on a CPU and compile longer
    remat: Literal["none", "blocks"] = runtime("none")  # blocks: the backward pass keeps only the blocks' inputs

    def __post_init__(self) -> None:
        for name in ("width", "blocks", "heads", "mlp_ratio", "patch_size", "unroll"):
            require(getattr(self, name) >= 1, f"model.{name} is {getattr(self, name)}; it must be at least 1")
        require(
            self.width % self.heads == 0 and self.width % 4 == 0,
            f"model.width is {self.width}; it must be divisible by model.heads {self.heads}, and by 4 for positions",
        )
        require(
            self.blocks % 2 == 0,
            f"model.blocks is {self.blocks}; half of the blocks attend over time, so it must be even",
        )
        require(
            self.conditioning == "frame" or not self.final_frame_ada,
            "model.final_frame_ada belongs to model.conditioning frame; with video the last layer always sees the "
            "actions, so leave it out",
        )


@dataclass(frozen=True)
class KLConfig:
    """An autoencoder with a Gaussian posterior in each cell. The defaults are SDXL's.

    Its training follows ``tokenizer_train``: steps, batch, optimizer, and the weights of l1, l2 and perceptual terms.
    """

    # sdxl: that of Stable Diffusion XL. magvit2: the tokenizer's convolutions, without a quantiser.
    network: Literal["sdxl", "magvit2"] = "sdxl"
    latent_channels: int = 4  # of a cell; fewer are easier to predict, and coarser
    channels: int = 128  # of the first level; times its multiplier, of each other one
    channel_multipliers: tuple[int, ...] = (1, 2, 4, 4)  # one per level; every level but the last halves the grid
    res_blocks: int = 2  # of each level
    norm_groups: int = 32  # of each group norm; smaller where it has to divide fewer channels
    patch_size: int = 1  # magvit2: space-to-depth before the first convolution
    local_codes: bool = False  # magvit2: a cell's latents depend on its own pixels alone
    kl_weight: float = 1e-4  # of the mean divergence of a latent number from the normal distribution
    # Whether depth maps are encoded as well, and how their colours are spaced (rsjax/data/depth_color.py). The latents
    # of a frame's depth are then further channels of the frame's, which the transformer denoises together: the way of
    # Aether and TesserAct.
    depth: Literal["none", "linear", "inverse"] = "none"
    compute_dtype: Literal["float32", "bfloat16"] = "float32"  # of convolutions, as in TokenizerConfig

    def __post_init__(self) -> None:
        require_range(self, "model.autoencoder", 1, math.inf, "latent_channels")
        require_range(self, "model.autoencoder", 0, math.inf, "kl_weight")
        require(
            self.network == "magvit2" or (self.patch_size == 1 and not self.local_codes),
            "model.autoencoder.patch_size and local_codes belong to the network magvit2; "
            "leave them at 1 and False, or set model.autoencoder.network",
        )
        try:
            self.convolutions  # noqa: B018 - checks the other fields
        except ConfigError as error:
            raise ConfigError(str(error).replace("tokenizer.", "model.autoencoder.")) from error

    @property
    def convolutions(self) -> TokenizerConfig:
        """The settings of the tokenizer's encoder and decoder of these sizes; the encoder's output is the posterior."""
        return TokenizerConfig(
            patch_size=self.patch_size,
            channels=self.channels,
            channel_multipliers=self.channel_multipliers,
            res_blocks=self.res_blocks,
            norm_groups=self.norm_groups,
            local_codes=self.local_codes,
            code_bits=2 * self.latent_channels,
            compute_dtype=self.compute_dtype,
        )

    @property
    def widths(self) -> tuple[int, ...]:
        """Channels of each level."""
        return tuple(self.channels * multiplier for multiplier in self.channel_multipliers)

    @property
    def downsampling(self) -> int:
        """Pixels per cell along each side."""
        return self.convolutions.downsampling


@register_family("irasim")
@dataclass(frozen=True)
class IRASimConfig(DiTConfig, ModelConfig):
    """IRASim (reference: its authors' public code): predicts the noise in a clip's latents; first frames are clean."""

    uses_tokenizer: ClassVar[bool] = True
    autoencoder: KLConfig = KLConfig()  # trained first, or converted
    action_dropout: float = 0.1  # share of the training clips whose actions are replaced by a learned embedding
    error_weight: float = 1.0  # of the squared error in the channels of RGB, all that there are without depth
    depth_weight: float = 1.0  # of the squared error in the channels of depth
    noise: NoiseConfig = NoiseConfig()  # the forward process
    sample: DenoiseConfig = sampling(DenoiseConfig())  # how clips are generated; may change after training

    def __post_init__(self) -> None:
        super().__post_init__()
        require_range(self, "model", 0, math.inf, "error_weight", "depth_weight")
        require(bool(self.loss_weights), "model.error_weight is 0, the only term: nothing would be learned; raise it")
        require(
            0 <= self.action_dropout < 1,
            f"model.action_dropout is {self.action_dropout}; it is a share of the clips, at least 0 and below 1",
        )
        self.sample.check(self.noise)

    @property
    def own_autoencoder(self) -> KLConfig:
        return self.autoencoder

    @property
    def uses_depth(self) -> bool:
        return self.autoencoder.depth != "none"

    @property
    def without_depth(self) -> str:
        return "--model.autoencoder.depth none"

    @property
    def loss_weights(self) -> dict[str, float]:
        off = set() if self.uses_depth else {"depth"}
        return {name: weight for name, weight in loss_weights(self).items() if name not in off}

    @property
    def scanned(self) -> int:
        return self.blocks // 2  # a pair of blocks each

    def check(self, clips: ClipShape) -> None:
        check_grid(clips, self.autoencoder.downsampling, self.patch_size)
