"""Public checkpoints into the project's own format and out again. ``python -m rsjax.convert --help``"""
