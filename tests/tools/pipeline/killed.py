"""``experiments.train``, killed without warning: ``python -m tests.tools.pipeline.killed PLACE PRESET …``.

PLACE is ``tokens`` (stage 3, half of its store written) or ``world_model`` (stage 4, after the checkpoint of step 2).
"""

import os
import signal
import sys
from typing import Any

from rsjax.tokenizers import tokenize
from rsjax.tools.commands.train import main
from rsjax.training.checkpoint import Checkpoints


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def in_tokens() -> None:
    record, count = tokenize.token_record, 0

    def dying(*args: Any) -> Any:
        nonlocal count
        count += 1
        if count == 4:
            die()
        return record(*args)

    tokenize.token_record = dying  # type: ignore[assignment]


def in_world_model() -> None:
    save = Checkpoints.save

    def dying(self: Checkpoints, step: int, *arguments: Any, **options: Any) -> None:
        save(self, step, *arguments, **options)
        if self.directory.parent.name == "world_model" and step == 2:
            self.wait()
            die()

    Checkpoints.save = dying  # type: ignore[method-assign]


if __name__ == "__main__":
    {"tokens": in_tokens, "world_model": in_world_model}[sys.argv.pop(1)]()
    main()
