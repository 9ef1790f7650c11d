"""``python -m experiments.export`` is ``rsjax export``."""

from rsjax.tools.commands.export import main

if __name__ == "__main__":
    main()
