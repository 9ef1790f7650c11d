"""``python -m experiments.synthesize`` is ``rsjax synthesize``."""

from rsjax.tools.commands.synthesize import main

if __name__ == "__main__":
    main()
