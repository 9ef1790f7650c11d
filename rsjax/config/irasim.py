"""Settings of IRASim, a diffusion transformer on the latents of a clip's frames."""

from dataclasses import dataclass
from typing import Literal

from rsjax.config.fields import require, runtime


@dataclass(frozen=True)
class DiTConfig:
    """A diffusion transformer on frames: blocks within frames and blocks over time take turns."""

    # frame: each action modulates the blocks within its frame (the paper's Frame-Ada). video: all actions together
    # modulate every block (Video-Ada).
    conditioning: Literal["frame", "video"] = "frame"
    # Between the two linear layers of the action encoder; none: as in the public model of Language-Table.
    action_activation: Literal["gelu", "none"] = "gelu"
    width: int = 1152
    blocks: int = 28  # half of them within frames, half over time
    heads: int = 16
    mlp_ratio: int = 4
    patch_size: int = 2  # cells of latents that one token covers, along each side
    compute_dtype: Literal["float32", "bfloat16"] = "float32"  # bfloat16: operands of linear layers
    remat: Literal["none", "blocks"] = runtime("none")  # blocks: the backward pass keeps the blocks' inputs alone

    def __post_init__(self) -> None:
        for name in ("width", "blocks", "heads", "mlp_ratio", "patch_size"):
            require(getattr(self, name) >= 1, f"model.{name} is {getattr(self, name)}; it must be at least 1")
        require(
            self.width % self.heads == 0 and self.width % 4 == 0,
            f"model.width is {self.width}; it must be divisible by model.heads {self.heads}, and by 4 for positions",
        )
        require(
            self.blocks % 2 == 0,
            f"model.blocks is {self.blocks}; half of the blocks attend over time, so it must be even",
        )
