"""``python -m experiments.record`` is ``rsjax record``."""

from rsjax.tools.commands.record import main

if __name__ == "__main__":
    main()
