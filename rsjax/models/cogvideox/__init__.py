"""CogVideoX (https://arxiv.org/abs/2408.06072): a diffusion transformer with full attention over text and video."""
