"""``python -m experiments.generate`` is ``rsjax generate``."""

from rsjax.tools.commands.generate import main

if __name__ == "__main__":
    main()
