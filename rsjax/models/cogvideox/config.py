"""Settings of CogVideoX: an autoencoder of videos, causal in time, and a diffusion transformer on its latents."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from rsjax.config.data import ClipShape
from rsjax.config.fields import require, require_range, runtime, sampling
from rsjax.config.model import ModelConfig, register_family
from rsjax.models.diffusion.config import DenoiseConfig, NoiseConfig, check_grid

ENCODED = 8  # frames that the autoencoder encodes in one piece
DECODED = 2  # latent frames that it decodes in one piece
COMPRESSION = 4  # frames per latent frame, after the first


@dataclass(frozen=True)
class CausalVAEConfig:
    """The autoencoder of videos; the defaults are the public network.

    Its training follows ``tokenizer_train``: steps, batch, optimizer, and the weights of l1, l2 and perceptual terms.
    It learns from ``frames_per_clip`` consecutive frames of a clip.
    """

    latent_channels: int = 16  # of a cell; fewer are easier to predict, and coarser
    patch_size: int = 1  # space-to-depth before the first convolution; 1 as in the public network, larger is cheaper
    # One for each level. Every level but the last halves the grid, the first two halve time too.
    widths: tuple[int, ...] = (128, 256, 256, 512)
    res_blocks: int = 3  # of a level in the encoder; the decoder has one more
    norm_groups: int = 32  # of each group norm; smaller where it has to divide fewer channels
    kl_weight: float = 1e-4  # of the mean divergence of a latent number from the normal distribution
    # The image that the model continues is a clip's first frame with noise of a deviation of exp(N(mean, deviation²)),
    # pixels being in ±1. This many noisy images are encoded for each clip; 0: the frame as it is.
    image_draws: int = 4
    image_noise: tuple[float, float] = (-3.0, 0.5)  # mean, deviation
    compute_dtype: Literal["float32", "bfloat16"] = "float32"  # of the operands of 3×3 and 3×3×3 convolutions

    def __post_init__(self) -> None:
        require_range(
            self, "model.autoencoder", 1, math.inf, "latent_channels", "patch_size", "res_blocks", "norm_groups"
        )
        require_range(self, "model.autoencoder", 0, math.inf, "kl_weight", "image_draws")
        require(
            len(self.widths) >= 3 and all(w > 0 and w % self.norm_groups == 0 for w in self.widths),
            f"model.autoencoder.widths are {self.widths}; give one for each level, three or more, all divisible by "
            f"norm_groups {self.norm_groups}",
        )
        require(
            len(self.image_noise) == 2 and self.image_noise[1] >= 0,
            f"model.autoencoder.image_noise is {self.image_noise}; it is a mean and a deviation, at least 0",
        )

    @property
    def downsampling(self) -> int:
        """Pixels per cell along each side."""
        return self.patch_size * 2 ** (len(self.widths) - 1)


def padded_frames(frames: int) -> int:
    """Returns the smallest 8k + 1 that is at least ``frames``: a length at which the autoencoder loses no frame."""
    return 1 + math.ceil((frames - 1) / ENCODED) * ENCODED


def latent_frames(frames: int) -> int:
    """Returns the number of latent frames of a video."""
    return (padded_frames(frames) - 1) // COMPRESSION + 1


@dataclass(frozen=True)
class TextConfig:
    """How the model knows a clip's task: embeddings of its words from a file, or learned tokens."""

    file: str = ""  # embeddings of the tasks, made by rsjax convert text; empty: learned tokens
    tokens: int = 226  # of each text; those of the file, if there is one
    width: int = 4096  # numbers of a token; 4096 in T5-XXL
    tasks: tuple[str, ...] = ()  # tasks with learned tokens of their own; empty: all clips share the same tokens
    dropout: float = 0.1  # share of the training clips that see the empty text

    def __post_init__(self) -> None:
        require_range(self, "model.text", 1, math.inf, "tokens", "width")
        require(0 <= self.dropout < 1, f"model.text.dropout is {self.dropout}; it is a share, at least 0 and below 1")
        require(
            not (self.file and self.tasks),
            "model.text.tasks have learned tokens, but model.text.file names embeddings; leave one of them empty",
        )


@dataclass(frozen=True)
class GuidedDenoiseConfig(DenoiseConfig):
    """Settings of the sampler with classifier-free guidance."""

    sampler: Literal["pndm", "ddim"] = "ddim"  # ddim: one network call a step
    # Trailing begins at the noisiest step, as zero_terminal needs.
    spacing: Literal["linspace", "leading", "trailing"] = "trailing"
    end_clean: bool = True  # as in the public sampler
    # g in v = without + g·(with - without the text). 1: no guidance; other values double the work.
    guidance: float = 6.0


@register_family("cogvideox")
@dataclass(frozen=True)
class CogVideoXConfig(ModelConfig):
    """CogVideoX: full attention over text and a clip's latents, v-prediction; the defaults are 5B-I2V. No actions."""

    uses_tokenizer: ClassVar[bool] = True
    autoencoder: CausalVAEConfig = CausalVAEConfig()  # trained first, or converted
    text: TextConfig = TextConfig()  # how the model knows the task
    width: int = 3072  # channels of the transformer
    blocks: int = 42  # of the transformer
    heads: int = 48  # of each attention; the width is theirs together
    mlp_ratio: int = 4  # width of an MLP's hidden layer, in widths of the model
    patch_size: int = 2  # cells of latents that one token covers, along each side
    time_width: int = 512  # channels of the embedding of the noise's step
    # How the model sees the image. channels: the image's latents are further channels of the first frame; those of
    # later frames are zeros. first_latent: the image is the first latent frame, without noise and not in the loss. The
    # public 2B sees no image and has no such channels.
    image: Literal["channels", "first_latent"] = "channels"
    image_dropout: float = 0.0  # share of the training clips without an image in its channels
    positions: Literal["rotary", "sincos"] = "rotary"  # rotary in 5B, sincos in 2B
    position_scale: float = 1.875  # sincos: rows and columns are divided by it
    # rotary: rows and columns over which positions are stretched, 30 and 45 in the public sampler. Empty: they count
    # 0, 1, 2 …, as in the public fine-tuner. Both are the same at 480×720 pixels.
    stretch: tuple[int, ...] = ()
    # Frames, rows and columns of learned positions, (13, 30, 45) in the public 5B-I2V, where they are near zero.
    learned_positions: tuple[int, ...] = ()
    compute_dtype: Literal["float32", "bfloat16"] = "float32"  # bfloat16: operands of linear layers and attention
    unroll: int = runtime(1)  # blocks per iteration of the scan; more are faster on a CPU and compile longer
    remat: Literal["none", "blocks"] = runtime("none")  # blocks: the backward pass keeps only the blocks' inputs
    error_weight: float = 1.0  # of the squared error, the only term
    # The forward process.
    noise: NoiseConfig = NoiseConfig(
        beta_start=0.00085, beta_end=0.012, betas="scaled_linear", prediction="velocity", zero_terminal=True
    )
    sample: GuidedDenoiseConfig = sampling(GuidedDenoiseConfig())  # how clips are generated; may change after training

    def __post_init__(self) -> None:
        sizes = ("width", "blocks", "heads", "mlp_ratio", "patch_size", "time_width", "unroll")
        require_range(self, "model", 1, math.inf, *sizes)
        require_range(self, "model", 0, math.inf, "error_weight")
        require(bool(self.loss_weights), "model.error_weight is 0, the only term: nothing would be learned; raise it")
        require(self.position_scale > 0, f"model.position_scale is {self.position_scale}; it must be above 0")
        require(
            0 <= self.image_dropout < 1,
            f"model.image_dropout is {self.image_dropout}; it is a share of the clips, at least 0 and below 1",
        )
        require(
            self.image == "channels" or not self.image_dropout,
            "model.image_dropout is above 0, but model.image first_latent has no channels to leave out; set it to 0",
        )
        rotary = self.positions == "rotary"
        head = self.width // self.heads
        require(
            self.width % self.heads == 0 and (head if rotary else self.width) % 16 == 0,
            f"model.width is {self.width}; it must be divisible by model.heads {self.heads}, and the "
            f"{'channels of a head' if rotary else 'width'} by 16 for positions",
        )
        for name, count in (("stretch", 2), ("learned_positions", 3)):
            setting = getattr(self, name)
            require(
                not setting or (len(setting) == count and min(setting) > 0),
                f"model.{name} is {setting}; it has {count} numbers above 0, or none",
            )
        self.sample.check(self.noise)
        require(
            self.sample.guidance == 1 or bool(self.text.file) or self.text.dropout > 0,
            f"model.sample.guidance is {self.sample.guidance}, but the learned tokens of the empty text are never "
            f"trained; set it to 1, or model.text.dropout above 0",
        )

    def for_tasks(self, tasks: tuple[str, ...]) -> "CogVideoXConfig":
        return self if self.text.file else replace(self, text=replace(self.text, tasks=tasks))

    @property
    def own_autoencoder(self) -> CausalVAEConfig:
        return self.autoencoder

    @property
    def takes_actions(self) -> bool:
        return False

    @property
    def scanned(self) -> int:
        return self.blocks

    def check(self, clips: ClipShape) -> None:
        token = check_grid(clips, self.autoencoder.downsampling, self.patch_size)
        grid = (latent_frames(clips.frames), clips.image_size // token, clips.image_size // token)
        require(
            self.learned_positions in ((), grid),
            f"model.learned_positions are for {self.learned_positions} frames, rows and columns, and these clips have "
            f"{grid}; set them alike or leave them out",
        )
