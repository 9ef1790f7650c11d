"""``python -m experiments.finetune`` is ``rsjax finetune``."""

from rsjax.tools.commands.finetune import main

if __name__ == "__main__":
    main()
