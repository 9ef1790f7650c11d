"""Several processes that train together through ``jax.distributed``: one on each host, or one for each device.

Process 0 is the lead: only it writes what must be written once. With one process, all functions here work and wait
for nobody.
"""

import importlib.util
import itertools
import json
import os
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from orbax.checkpoint import multihost

from rsjax.errors import Preempted, UserError, first_line
from rsjax.runtime import patient

BARRIER_SECONDS = 7 * 24 * 3600  # the others wait while the lead simulates, tokenizes and evaluates
JOIN_SECONDS = 1800  # replacing a lost node can take long
SHUTDOWN_SECONDS = 30  # how long a process that failed waits for the others before it exits

# The variable that a launcher sets for each process that it starts, and the one with the number of processes.
_LAUNCHERS = {"OMPI_MCA_orte_hnp_uri": "OMPI_COMM_WORLD_SIZE", "SLURM_STEP_NODELIST": "SLURM_NTASKS"}

_numbers = itertools.count()  # all processes pass the same barriers in the same order

Json = TypeVar("Json")  # a JSON-ready value


class HostsError(UserError):
    """Several processes have contradictory options, or their lead failed."""


class LostHostError(HostsError):
    """Processes cannot join each other, or one lost the others: start them again."""

    status = os.EX_TEMPFAIL


def has_peers(environ: Mapping[str, str]) -> bool:
    """Returns whether this process was started as one of several by Open MPI, Slurm, GKE or Kubernetes.

    ``jax.distributed.initialize`` recognizes these itself, but cannot be called to find out: without a cluster it
    fails, it gives a lone Slurm task or MPI rank only one of all GPUs, and it has to come before any computation.

    Args:
        environ: environment variables; nothing else is read, and no server is asked.

    Raises:
        HostsError: a variable for the number of processes is not a number.
    """
    if any(mark in environ and _count(environ, size) > 1 for mark, size in _LAUNCHERS.items()):
        return True
    tpu_hosts = environ.get("TPU_PROCESS_ADDRESSES") or environ.get("TPU_WORKER_HOSTNAMES", "")
    if tpu_hosts:
        return "," in tpu_hosts or _count(environ, "MEGASCALE_NUM_SLICES") > 1
    return "JOB_COMPLETION_INDEX" in environ and importlib.util.find_spec("kubernetes") is not None


def _count(environ: Mapping[str, str], name: str) -> int:
    value = environ.get(name) or "1"
    if not (value.isascii() and value.isdecimal()):
        raise HostsError(f"{name} is {value!r}, not a number of processes; unset it, or name the processes by options")
    return int(value)


def initialize(coordinator: str = "", processes: int | None = None, process_id: int | None = None) -> None:
    """Joins the processes that were started together. Call it before jax uses a device. One process does nothing.

    Args:
        coordinator: HOST:PORT of process 0, reachable by all. Without any of the three arguments, jax gets them from
            the cluster.
        processes: number of processes.
        process_id: number of this process, 0 … processes - 1.

    Raises:
        HostsError: an option is missing or out of range, or the processes cannot join each other.
    """
    alone = not coordinator and processes is None and process_id is None
    peers = alone and has_peers(os.environ)
    # A machine of a TPU pod has peers that only Google's metadata server knows. jax sets the variable when it is
    # imported on a machine without TPU chips.
    on_tpu = "TPU_SKIP_MDS_QUERY" not in os.environ and importlib.util.find_spec("libtpu") is not None
    if alone and not peers and not on_tpu:
        return
    arguments: dict[str, Any] = {}
    if not alone:
        options = {"--coordinator": coordinator or None, "--processes": processes, "--process-id": process_id}
        missing = [name for name, value in options.items() if value is None]
        if processes is None or process_id is None or missing:
            raise HostsError(
                f"{' and '.join(missing)} missing; several hosts need {', '.join(options)}, or none of them"
            )
        if not 0 <= process_id < processes:
            raise HostsError(f"--process-id is {process_id}; with --processes {processes} it is 0 … {processes - 1}")
        host, _, port = coordinator.rpartition(":")
        if not host or not (port.isascii() and port.isdecimal() and 0 < int(port) < 2**16):
            raise HostsError(f"--coordinator is {coordinator!r}; it is HOST:PORT of process 0")
        arguments = {
            "coordinator_address": coordinator,
            "num_processes": processes,
            "process_id": process_id,
            "cluster_detection_method": "deactivate",  # with Slurm's on, a process would get only one of its devices
        }
    if processes == 1:
        return
    # Otherwise jax handles SIGTERM itself, and a process that gets it does not stop.
    jax.config.update("jax_enable_preemption_service", False)
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(
            **arguments, initialization_timeout=JOIN_SECONDS, shutdown_timeout_seconds=SHUTDOWN_SECONDS
        )
    except Exception as error:  # jax reads a cluster's variables without checks
        if alone and not peers and isinstance(error, ValueError):
            return  # a TPU machine that is not part of a pod
        raise LostHostError(
            f"process {'of a cluster' if alone else process_id} cannot join the others ({first_line(error)}); start "
            f"all of them, with the same --coordinator and --processes, and a --coordinator that all of them can reach"
        ) from error
    patient.set()  # a process that ended alone would end the others too


def is_lead() -> bool:
    """Returns whether this process is the lead, which writes what must be written once."""
    return jax.process_index() == 0


def barrier(name: str) -> None:
    """Waits until every process has called this.

    Args:
        name: names the place in the error.

    Raises:
        LostHostError: another process is gone.
    """
    wait = multihost.get_barrier_sync_fn()
    try:
        wait(key=f"rsjax-{next(_numbers)}-{name}", timeout_ms=BARRIER_SECONDS * 1000)
    except jax.errors.JaxRuntimeError as error:
        raise LostHostError(
            f"another process was lost ({name}); its own message says why; start all of them again"
        ) from error


def agree(value: Json, name: str = "agree") -> Json:
    """Returns the lead's ``value`` on every process. All processes have to call it.

    Args:
        value: JSON-ready. The other processes' values are ignored.
        name: as in :func:`barrier`.
    """
    if jax.process_count() == 1:
        return value
    barrier(name)  # first, as a collective of the devices would not wait as long
    text = json.dumps(value).encode() if is_lead() else b""
    size = int(multihost_utils.broadcast_one_to_all(np.int32(len(text))))
    padded = np.zeros(-(-size // 256) * 256, np.uint8)  # rounded up to few sizes, as each one is compiled
    padded[: len(text)] = np.frombuffer(text, np.uint8)
    return json.loads(bytes(multihost_utils.broadcast_one_to_all(padded))[:size])


def anywhere(flag: bool) -> bool:
    """Returns whether ``flag`` is set on any process. All processes have to call it."""
    return bool(np.any(multihost_utils.process_allgather(np.asarray(flag))))


def on_lead(name: str, work: Callable[..., object], *arguments: Any) -> None:
    """Calls ``work(*arguments)`` on the lead while the others wait. If it fails, it fails on all processes.

    Raises:
        HostsError: on the others, if it failed on the lead.
        Preempted: on the others, if the lead was stopped.
    """
    failure: BaseException | None = None
    if is_lead():
        try:
            work(*arguments)
        except BaseException as error:
            if jax.process_count() == 1:
                raise
            failure = error
    reason = agree(None if failure is None else f"{type(failure).__name__}: {failure}", name)
    if failure is not None:
        raise failure
    if reason is not None:
        if reason.startswith(f"{Preempted.__name__}: "):
            raise Preempted(reason)
        raise HostsError(f"{name} failed on process 0 ({reason})")
