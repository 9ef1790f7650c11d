"""``python -m experiments.evaluate`` is ``rsjax evaluate``."""

from rsjax.tools.commands.evaluate import main

if __name__ == "__main__":
    main()
