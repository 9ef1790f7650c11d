"""``python -m experiments.compare`` is ``rsjax compare``."""

from rsjax.tools.commands.compare import main

if __name__ == "__main__":
    main()
