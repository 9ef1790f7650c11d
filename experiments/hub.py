"""``python -m experiments.hub`` is ``rsjax hub``."""

from rsjax.tools.commands.hub import main

if __name__ == "__main__":
    main()
