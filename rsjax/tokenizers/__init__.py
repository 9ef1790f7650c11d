"""The tokenizer of RGB frames and colourised depth maps: MAGVIT-2 with lookup-free quantisation, and its training."""
