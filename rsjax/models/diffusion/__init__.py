"""Parts that diffusion models share: noise schedules, samplers, fixed positions and adaptive norms."""
