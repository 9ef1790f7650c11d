"""``python -m experiments.train`` is ``rsjax train``."""

from rsjax.tools.commands.train import main

if __name__ == "__main__":
    main()
