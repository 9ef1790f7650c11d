"""The executor of a Ray cluster: a pool of actors for each stage, with the CPUs and fractions of GPUs that it asks for.

Messages are units (paths and ids) and marks; pictures stay where they are. Every node has to see the data set and the
job's folder under the same paths. Ray is an extra (``pip install 'rsjax[ray]'``).
"""

import math
import os
from collections import Counter
from collections.abc import Mapping
from typing import Any

from rsjax.errors import UserError
from rsjax.ingest.jobs.runner import Outcome, limit_threads, opened
from rsjax.ingest.jobs.work_items import Job, Mark, Unit, Work, run_unit

MAX_FAILED_STARTS = 3  # of a stage's actors, until it is the installation and not a node
OBJECT_STORE_BYTES = 100 * 2**20  # of a local cluster: messages are small


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
        most: see ``workers``; None: no limit.
        cpus: that a local cluster has; None: the machine's, or as many as one actor of each stage needs.
        patience: seconds in which the cluster is to find a place for one actor of each stage, where none works.

    Raises:
        RayError: Ray is missing, the cluster cannot be reached, or it cannot hold one actor of each stage at once.
    """

    def __init__(
        self,
        job: Job,
        address: str = "local",
        workers: Mapping[str, int] | None = None,
        most: int | None = None,
        cpus: float | None = None,
        patience: float = 300.0,
    ) -> None:
        self._ray, self._job, self._patience = load_ray(), job, patience
        self._started = not self._ray.is_initialized()
        if self._started:
            self._connect(address, cpus)
        self._shared = self._ray.put(job)
        self._actor = self._ray.remote(max_restarts=0, max_task_retries=0)(_Actor)
        self._idle: dict[str, list[Any]] = {stage.name: [] for stage in job.stages}
        self._busy: dict[Any, tuple[Any, Unit]] = {}  # actor and unit by the future of the mark
        self._starting: dict[Any, tuple[Any, str]] = {}  # actor and stage by the future of the process id
        self._failed_starts = Counter[str]()  # by stage
        try:
            for name, number in self._counts(dict(workers or {}), math.inf if most is None else most).items():
                for _ in range(number):
                    self._start(name)
            while not all(self._idle.values()):
                self._settle_started(self._next())
        except BaseException:
            self.close()
            raise

    def accepts(self, stage: str) -> bool:
        return bool(self._idle[stage])

    def submit(self, unit: Unit) -> None:
        actor = self._idle[unit.stage].pop()
        self._busy[actor.run.remote(unit)] = actor, unit

    def wait(self) -> list[Outcome]:
        future = self._next()
        if future in self._busy:
            return [self._receive(future)]
        self._settle_started(future)
        return []

    def close(self) -> None:
        idle = [actor for actors in self._idle.values() for actor in actors]
        for actor in idle + [actor for actor, _ in [*self._busy.values(), *self._starting.values()]]:
            self._ray.kill(actor)
        if self._started:
            self._ray.shutdown()

    def pids(self) -> dict[str, list[int]]:
        """The process ids of the actors that have no unit, by stage; waits for those that are starting."""
        actors = {name: list(idle) for name, idle in self._idle.items()}
        for actor, stage in self._starting.values():
            actors[stage].append(actor)
        return {name: self._ray.get([actor.pid.remote() for actor in each]) for name, each in actors.items()}

    def __enter__(self) -> "RayExecutor":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _connect(self, address: str, cpus: float | None) -> None:
        options: dict[str, Any] = {}
        if address == "local":
            needed = math.ceil(sum(stage.cpus for stage in self._job.stages))
            options = {
                "num_cpus": cpus or max(os.cpu_count() or 1, needed),
                "include_dashboard": False,
                "object_store_memory": OBJECT_STORE_BYTES,
            }
        try:
            self._ray.init(address=address, log_to_driver=False, logging_level="error", **options)
        except Exception as error:  # Ray raises several kinds, of a start that took too long a bare Exception
            told = " ".join(str(error).split())
            raise RayError(f"no Ray cluster at {address}: {told}; start it, or leave --ray-address out") from error

    def _counts(self, given: dict[str, int], most: float) -> dict[str, int]:
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
                        f"one worker of each stage at once; lower --cpus or --gpus, or add nodes"
                    )
                if fits and counts[stage.name] < given.get(stage.name, most):
                    counts[stage.name] += 1
                    left = {name: left[name] - amount for name, amount in wanted.items()}
                    growing = True
        return counts

    def _start(self, stage: str) -> None:
        """Asks for an actor. It is idle once the cluster has found a place for it, which may be never."""
        needed = self._job.stage(stage)
        actor = self._actor.options(num_cpus=needed.cpus, num_gpus=needed.gpus).remote(self._shared, stage)
        self._starting[actor.pid.remote()] = actor, stage

    def _next(self) -> Any:
        """The future that is ready next, of a unit or of a start."""
        patience = None if self._busy else self._patience
        ready, _ = self._ray.wait([*self._busy, *self._starting], num_returns=1, timeout=patience)
        if not ready:
            missing = sorted({stage for _, stage in self._starting.values()})
            raise RayError(
                f"the Ray cluster found no place for a worker of {', '.join(missing)} within {self._patience:g} s; "
                f"look at its other jobs and at the CPUs and GPUs of each node"
            )
        return ready[0]

    def _settle_started(self, future: Any) -> None:
        actor, stage = self._starting.pop(future)
        try:
            self._ray.get(future)
        except self._ray.exceptions.RayError as error:
            self._failed_starts[stage] += 1
            if self._failed_starts[stage] < MAX_FAILED_STARTS:
                self._start(stage)
                return
            told = str(error).strip().splitlines()[-1]
            raise RayError(f"a Ray worker of {stage} cannot start: {told}; install rsjax on every node") from error
        self._idle[stage].append(actor)

    def _receive(self, future: Any) -> Outcome:
        actor, unit = self._busy.pop(future)
        try:
            answer = self._ray.get(future)
        except self._ray.exceptions.RayTaskError:  # a bug, which Ray tells with its traceback
            raise
        except self._ray.exceptions.RayError:  # the actor is gone, or its node
            self._start(unit.stage)
            return Outcome(unit, None)
        self._idle[unit.stage].append(actor)
        if isinstance(answer, UserError):
            raise answer
        return Outcome(unit, answer)


class _Actor:
    """One stage's worker."""

    def __init__(self, job: Job, stage: str) -> None:
        limit_threads(max(1, math.ceil(job.stage(stage).cpus)))
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
