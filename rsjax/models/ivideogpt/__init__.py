"""iVideoGPT (https://arxiv.org/abs/2405.15223): a LLaMA on a few tokens a frame, from a tokenizer with context."""
