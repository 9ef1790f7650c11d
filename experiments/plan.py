"""``python -m experiments.plan`` is ``rsjax plan``."""

from rsjax.tools.commands.plan import main

if __name__ == "__main__":
    main()
