"""The executor of a Ray cluster: a pool of actors for each stage, with the CPUs and fractions of GPUs that it asks for.

Messages are units (paths and ids) and marks; pictures stay where they are. Every node has to see the data set and the
job's folder under the same paths. Ray is an extra (``pip install 'rsjax[ray]'``).
"""

import math
import os
from collections.abc import Mapping
from typing import Any

from rsjax.annotate.runner import Outcome, opened
from rsjax.annotate.units import Job, Mark, Unit, Work, run_unit
from rsjax.errors import UserError


class RayError(UserError):
    """Ray is missing or its cluster cannot do the job. The message names the cure."""


def load_ray() -> Any:
    """The package.

    Raises:
        RayError: it is not installed.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise RayError("--runner ray needs Ray: pip install 'rsjax[ray]'") from error
    return ray


class RayExecutor:
    """Actors on a cluster, or on this machine. Close it, or use it as a context manager.

    Args:
        job: put into the object store once.
        address: of a cluster; "local" starts one on this machine, which ends with :meth:`close`.
        workers: actors by stage's name; a stage that is not named has as many as its CPUs and GPUs allow, up to
            ``most``.
        most: see ``workers``.
        cpus: that a local cluster has; None: the machine's, or as many as one actor of each stage needs.

    Raises:
        RayError: Ray is missing, the cluster cannot be reached, or it cannot hold one actor of each stage at once.
    """

    def __init__(
        self,
        job: Job,
        address: str = "local",
        workers: Mapping[str, int] | None = None,
        most: int = 8,
        cpus: float | None = None,
    ) -> None:
        self._ray, self._job = load_ray(), job
        self._started = not self._ray.is_initialized()
        if self._started:
            self._connect(address, cpus)
        self._shared = self._ray.put(job)
        self._actor = self._ray.remote(max_restarts=0, max_task_retries=0)(_Actor)
        try:
            counts = self._counts(dict(workers or {}), most)
        except RayError:
            self._disconnect()
            raise
        self._idle = {name: [self._start(name) for _ in range(number)] for name, number in counts.items()}
        self._busy: dict[Any, tuple[Any, Unit]] = {}  # actor and unit by the future of the mark

    def accepts(self, stage: str) -> bool:
        return bool(self._idle[stage])

    def submit(self, unit: Unit) -> None:
        actor = self._idle[unit.stage].pop()
        self._busy[actor.run.remote(unit)] = actor, unit

    def wait(self) -> list[Outcome]:
        ready, _ = self._ray.wait(list(self._busy), num_returns=1)
        return [self._receive(future) for future in ready]

    def close(self) -> None:
        for actor in self._actors():
            self._ray.kill(actor)
        self._disconnect()

    def pids(self) -> dict[str, list[int]]:
        """The idle actors' process ids, by stage."""
        return {name: self._ray.get([actor.pid.remote() for actor in idle]) for name, idle in self._idle.items()}

    def __enter__(self) -> "RayExecutor":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _connect(self, address: str, cpus: float | None) -> None:
        options: dict[str, Any] = {}
        if address == "local":
            needed = sum(stage.cpus for stage in self._job.stages)
            options = {"num_cpus": cpus or max(os.cpu_count() or 1, math.ceil(needed)), "include_dashboard": False}
        try:
            self._ray.init(address=address, log_to_driver=False, logging_level="warning", **options)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise RayError(f"no Ray cluster at {address}: {error}; start it, or leave --ray-address out") from error

    def _disconnect(self) -> None:
        if self._started:
            self._ray.shutdown()

    def _counts(self, given: dict[str, int], most: int) -> dict[str, int]:
        """Actors of each stage: one each first, then evenly while the cluster's CPUs and GPUs last."""
        have = self._ray.cluster_resources()
        left = {name: float(have.get(name, 0.0)) for name in ("CPU", "GPU")}
        counts = {stage.name: 0 for stage in self._job.stages}
        growing = True
        while growing:
            growing = False
            for stage in self._job.stages:
                wanted = {"CPU": stage.cpus, "GPU": stage.gpus}
                fits = all(left[name] >= amount - 1e-6 for name, amount in wanted.items())
                if counts[stage.name] == 0 and not fits:
                    raise RayError(
                        f"the Ray cluster has {have.get('CPU', 0):g} CPUs and {have.get('GPU', 0):g} GPUs, too few for "
                        f"one worker of each stage at once; ask for less per stage, or add nodes"
                    )
                if fits and counts[stage.name] < given.get(stage.name, most):
                    counts[stage.name] += 1
                    left = {name: left[name] - amount for name, amount in wanted.items()}
                    growing = True
        return counts

    def _start(self, stage: str) -> Any:
        needed = self._job.stage(stage)
        return self._actor.options(num_cpus=needed.cpus, num_gpus=needed.gpus).remote(self._shared, stage)

    def _actors(self) -> list[Any]:
        return [actor for idle in self._idle.values() for actor in idle] + [actor for actor, _ in self._busy.values()]

    def _receive(self, future: Any) -> Outcome:
        actor, unit = self._busy.pop(future)
        try:
            answer = self._ray.get(future)
        except self._ray.exceptions.RayTaskError:  # a bug, which Ray tells with its traceback
            raise
        except self._ray.exceptions.RayError:  # the actor is gone, or its node
            self._idle[unit.stage].append(self._start(unit.stage))
            return Outcome(unit, None)
        self._idle[unit.stage].append(actor)
        if isinstance(answer, UserError):
            raise answer
        return Outcome(unit, answer)


class _Actor:
    """One stage's worker."""

    def __init__(self, job: Job, stage: str) -> None:
        self._job, self._stage = job, stage
        self._works: dict[str, Work] = {}

    def run(self, unit: Unit) -> Mark | UserError:
        """The unit's mark, or why no unit could be worked on."""
        try:
            return run_unit(self._job, unit, opened(self._job, self._stage, self._works))
        except UserError as error:
            return error

    def pid(self) -> int:
        """Of its process."""
        return os.getpid()
