"""Experiments on policies: learning, judging, improving, synthesising."""
