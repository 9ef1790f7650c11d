"""``experiments.adapt``, killed without warning: ``python -m tests.tools.policies.killed PLACE RUN …``.

PLACE is ``rollouts`` (the policy has acted in one of its groups of episodes) or ``world_model`` (after the checkpoint
of step 2).
"""

import sys
from pathlib import Path

from experiments.adapt import main
from rsjax.tools.policies import on_policy
from tests.tools.pipeline.killed import die, in_world_model


def in_rollouts() -> None:
    write = on_policy.write_file

    def dying(path: Path, payload: bytes) -> None:
        write(path, payload)
        die()

    on_policy.write_file = dying  # type: ignore[assignment]


if __name__ == "__main__":
    {"rollouts": in_rollouts, "world_model": in_world_model}[sys.argv.pop(1)]()
    main()
