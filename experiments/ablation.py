"""``python -m experiments.ablation`` is ``rsjax ablation``."""

from rsjax.tools.commands.ablation import main

if __name__ == "__main__":
    main()
