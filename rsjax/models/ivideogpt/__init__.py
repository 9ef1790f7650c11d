"""iVideoGPT (https://arxiv.org/abs/2405.15223): a LLaMA on few tokens per frame, from a tokenizer with context."""
