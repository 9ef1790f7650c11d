"""Runs the work items of an ingest on a Ray cluster: a pool of actors for each step, with its CPUs and shares of GPUs.

Messages contain only ids, locations and marks; pictures are not sent. Every node must see the data set and the plan's
folder under the same paths. Ray is an optional package (``pip install 'rsjax[ray]'``).
"""

import asyncio
import math
import os
import socket
from collections.abc import Mapping, Sequence
from typing import Any

from rsjax.errors import UserError
from rsjax.processes import MAX_DEATHS, WorkerDied
from rsjax.tools.ingest.episode import EpisodeRef
from rsjax.tools.ingest.ingest import Settle, limit_threads
from rsjax.tools.ingest.work_items import EpisodeWork, IngestPlan, ItemMark, Step, run_item

ANSWER_SECONDS = 5.0  # time that a cluster's address has to answer
MAX_FAILED_STARTS = 3  # of an actor, after which the installation is to blame and not a node
MAX_WAITING = 16  # episodes in progress beyond one per actor; they wait between steps
OBJECT_STORE_BYTES = 100 * 2**20  # of a local cluster: messages are small


class RayError(UserError):
    """Ray is missing or its cluster cannot run the ingest. The message names the cure."""


def run_on_ray(
    plan: IngestPlan,
    refs: Sequence[EpisodeRef],
    settle: Settle,
    address: str = "local",
    most: int | None = None,
    cpus: float | None = None,
    patience: float = 300.0,
) -> None:
    """Runs the work items on a cluster. A :data:`rsjax.tools.ingest.ingest.Runner`.

    Args:
        address: the cluster's address; "local" starts one on this machine and stops it at the end.
        most: largest number of actors of each step; None: as many as the CPUs and GPUs allow.
        cpus: CPUs of a local cluster; None: the machine's, or as many as one actor of each step needs.
        patience: seconds to wait for an idle actor of a step while no work item runs.

    Raises:
        RayError: Ray is missing, the cluster cannot be reached, or it cannot place one actor of each step at once.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise RayError("--runner ray needs Ray: pip install 'rsjax[ray]'") from error
    here = not ray.is_initialized()
    if here:
        options: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
        if address == "local":
            needed = math.ceil(sum(step.cpus for step in plan.steps))
            options |= {
                "num_cpus": cpus or max(os.cpu_count() or 1, needed),
                "include_dashboard": False,
                "object_store_memory": OBJECT_STORE_BYTES,
            }
        check_answers(address)
        try:
            ray.init(address=address, **options)
        except Exception as error:  # Ray raises several types, and a bare Exception for a start that took too long
            message = " ".join(str(error).split())
            raise RayError(f"no Ray cluster at {address}: {message}; start it, or leave --ray-address out") from error
    try:
        counts = count_actors(plan.steps, ray.cluster_resources(), most)
        asyncio.run(_Actors(ray, plan, patience).run(refs, counts, settle))
    finally:
        if here:
            ray.shutdown()


def check_answers(address: str) -> None:
    """Raises :class:`RayError` if nobody answers at ``HOST:PORT`` or ``ray://HOST:PORT``; Ray would try for minutes."""
    if address == "auto":
        address = os.environ.get("RAY_ADDRESS", address)
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (port.isascii() and port.isdecimal()):  # Ray reports what is wrong with it, or finds a cluster itself
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=ANSWER_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise RayError(
            f"no Ray cluster at {address}: nobody answers ({error}); start it, or leave --ray-address out"
        ) from error


def count_actors(steps: Sequence[Step], cluster: Mapping[str, float], most: int | None = None) -> dict[str, int]:
    """Returns the number of actors of each step: one each first, then evenly while CPUs and GPUs last.

    Args:
        cluster: the numbers of CPUs (``CPU``) and GPUs (``GPU``).
        most: largest number of actors of each step; None: no limit.

    Raises:
        RayError: CPUs or GPUs do not suffice for one actor of each step.
    """
    left = {name: float(cluster.get(name, 0.0)) for name in ("CPU", "GPU")}
    counts = {step.name: 0 for step in steps}
    growing = True
    while growing:
        growing = False
        for step in steps:
            needed = {"CPU": step.cpus, "GPU": step.gpus}
            fits = all(left[name] >= amount - 1e-6 for name, amount in needed.items())
            if counts[step.name] == 0 and not fits:
                raise RayError(
                    f"the Ray cluster has {cluster.get('CPU', 0):g} CPUs and {cluster.get('GPU', 0):g} GPUs, too few "
                    f"for one worker of each step at once; lower --cpus or --gpus, or add nodes"
                )
            if fits and (most is None or counts[step.name] < most):
                counts[step.name] += 1
                left = {name: left[name] - amount for name, amount in needed.items()}
                growing = True
    return counts


class _Actors:
    """The actors of each step, and which of them are idle. An actor that dies is replaced."""

    def __init__(self, ray: Any, plan: IngestPlan, patience: float) -> None:
        self._ray = ray
        self._plan = plan
        self._patience = patience
        self._shared = ray.put(plan)
        self._class = ray.remote(max_restarts=0, max_task_retries=0)(_Actor)
        self._idle: dict[str, asyncio.Queue[Any]] = {step.name: asyncio.Queue() for step in plan.steps}
        self._actors: list[Any] = []
        self._starting: set[asyncio.Task[None]] = set()
        self._running = 0  # number of work items

    async def run(self, refs: Sequence[EpisodeRef], counts: Mapping[str, int], settle: Settle) -> None:
        """Runs the work items of these episodes on ``counts`` actors of each step, and stops the actors."""
        for step in self._plan.steps:
            for _ in range(counts[step.name]):
                self._begin_start(step)
        rest = iter(refs)

        async def lane() -> None:
            for ref in rest:
                settle(ref, *await self._run_episode(ref))

        try:
            await asyncio.gather(*(lane() for _ in range(sum(counts.values()) + MAX_WAITING)))
        finally:
            for actor in self._actors:
                self._ray.kill(actor)

    async def _run_episode(self, ref: EpisodeRef) -> tuple[int, int]:
        """Does what :func:`rsjax.tools.ingest.work_items.run_episode` does, each step on an actor of its own."""
        work = EpisodeWork(self._plan, ref)
        ran = 0
        clips = 0
        for step in self._plan.steps:
            mark = work.mark(step.name)
            if mark is None:
                mark = await self._run_item(work, step)
                ran += 1
                if step is self._plan.steps[-1]:
                    clips += mark.get("records", 0)
            if mark["status"] == "failed":
                break
        return ran, clips

    async def _run_item(self, work: EpisodeWork, step: Step) -> ItemMark:
        for _ in range(MAX_DEATHS):
            actor = await self._take_idle(step)
            self._running += 1
            try:
                answer = await actor.run.remote(work.ref)
            except self._ray.exceptions.RayTaskError:  # a bug; Ray adds the actor's traceback
                raise
            except self._ray.exceptions.RayError:  # the actor or its node died
                self._begin_start(step)
                continue
            finally:
                self._running -= 1
            self._idle[step.name].put_nowait(actor)
            if isinstance(answer, UserError):
                raise answer
            return answer
        return work.fail(step.name, WorkerDied())

    async def _take_idle(self, step: Step) -> Any:
        """Waits for an idle actor of a step; gives up if no work item runs after ``patience`` seconds."""
        while True:
            try:
                actor = await asyncio.wait_for(self._idle[step.name].get(), self._patience)
            except TimeoutError as error:
                if self._running:
                    continue
                raise RayError(
                    f"the Ray cluster found no place for a worker of {step.name} within {self._patience:g} s; look at "
                    f"its other jobs and at the CPUs and GPUs of each node"
                ) from error
            if isinstance(actor, RayError):
                raise actor
            return actor

    def _begin_start(self, step: Step) -> None:
        task = asyncio.create_task(self._start(step))
        self._starting.add(task)  # asyncio itself keeps no reference
        task.add_done_callback(self._starting.discard)

    async def _start(self, step: Step) -> None:
        """Starts an actor, which becomes idle once the cluster has placed it; this may never happen."""
        for attempt in range(MAX_FAILED_STARTS):
            actor = self._class.options(num_cpus=step.cpus, num_gpus=step.gpus).remote(self._shared, step.name)
            self._actors.append(actor)
            try:
                await actor.ready.remote()
            except self._ray.exceptions.RayError as error:
                message = str(error).strip().splitlines()[-1]
                failed = RayError(f"a Ray worker of {step.name} cannot start: {message}; install rsjax on every node")
                if attempt + 1 == MAX_FAILED_STARTS:
                    self._idle[step.name].put_nowait(failed)
            else:
                self._idle[step.name].put_nowait(actor)
                return


class _Actor:
    """One step's worker, in a process of the cluster."""

    def __init__(self, plan: IngestPlan, step: str) -> None:
        self._plan = plan
        self._step = next(each for each in plan.steps if each.name == step)
        self._prepared: set[str] = set()
        limit_threads(max(1, math.ceil(self._step.cpus)))

    def run(self, ref: EpisodeRef) -> ItemMark | UserError:
        """Returns the mark of this step on an episode, or the error because of which no work item could be run."""
        try:
            return run_item(EpisodeWork(self._plan, ref), self._step, self._prepared)
        except UserError as error:
            return error

    def ready(self) -> None:
        """Returns once the actor has started."""
