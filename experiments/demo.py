"""``python -m experiments.demo`` is ``rsjax demo``."""

from rsjax.tools.commands.demo import main

if __name__ == "__main__":
    main()
