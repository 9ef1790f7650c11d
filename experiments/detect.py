"""``python -m experiments.detect`` is ``rsjax detect``."""

from rsjax.tools.commands.detect import main

if __name__ == "__main__":
    main()
