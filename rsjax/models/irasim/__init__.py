"""IRASim (https://arxiv.org/abs/2406.14540): a latent video diffusion transformer with frame-level actions."""
