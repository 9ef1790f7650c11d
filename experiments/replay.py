"""``python -m experiments.replay`` is ``rsjax replay``."""

from rsjax.tools.commands.replay import main

if __name__ == "__main__":
    main()
