"""``python -m experiments.play`` is ``rsjax play``."""

from rsjax.tools.commands.play import main

if __name__ == "__main__":
    main()
