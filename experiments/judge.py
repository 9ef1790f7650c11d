"""``python -m experiments.judge`` is ``rsjax judge``."""

from rsjax.tools.commands.judge import main

if __name__ == "__main__":
    main()
