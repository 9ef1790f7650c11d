"""``python -m experiments.bench`` is ``rsjax bench``."""

from rsjax.tools.commands.bench import main

if __name__ == "__main__":
    main()
