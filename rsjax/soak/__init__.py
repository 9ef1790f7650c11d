"""The soak: a training command disturbed at random, again and again, and held against a run that nothing disturbed."""
