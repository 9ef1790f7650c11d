"""``python -m experiments.doctor`` is ``rsjax doctor``."""

from rsjax.tools.commands.doctor import main

if __name__ == "__main__":
    main()
