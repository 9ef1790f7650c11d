"""Several processes that train together, through ``jax.distributed``: one a host, or one a device.

Process 0 is the lead: it alone writes what is written once. On one host all of this does nothing, or the obvious.
"""

import importlib.util
import itertools
import json
import os
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from orbax.checkpoint import multihost

from rsjax.errors import Preempted, UserError, first_line

BARRIER_SECONDS = 7 * 24 * 3600  # the others wait while the lead simulates, tokenizes and evaluates
JOIN_SECONDS = 1800  # a node that takes another's place may be long in coming
SHUTDOWN_SECONDS = 30  # how long a process that failed waits for the others before it exits

_numbers = itertools.count()  # all processes come to the same barriers in the same order


class HostsError(UserError):
    """Several processes that were not told how to join each other, or whose lead failed."""


class LostHostError(HostsError):
    """Processes that cannot join each other, or one that lost the others: to be started again."""

    status = os.EX_TEMPFAIL


def cluster(environ: Mapping[str, str]) -> str:
    """What started this process as one of several, as jax names it: slurm, ompi, gketpu, k8s, or tpu (to be asked for).

    Args:
        environ: environment variables.

    Returns:
        The name; empty where this is a process of its own.
    """
    tpu_hosts = environ.get("TPU_PROCESS_ADDRESSES") or environ.get("TPU_WORKER_HOSTNAMES", "")
    slices = int(environ.get("MEGASCALE_NUM_SLICES") or 1)
    if "SLURM_STEP_NODELIST" in environ and int(environ.get("SLURM_NTASKS", 1)) > 1:
        return "slurm"
    if "OMPI_MCA_orte_hnp_uri" in environ and int(environ.get("OMPI_COMM_WORLD_SIZE", 1)) > 1:
        return "ompi"
    if tpu_hosts:
        return "gketpu" if "," in tpu_hosts or slices > 1 else ""
    if "JOB_COMPLETION_INDEX" in environ and importlib.util.find_spec("kubernetes"):
        return "k8s"
    # A TPU machine of a pod knows the others from Google's metadata server alone.
    return "tpu" if importlib.util.find_spec("libtpu") and "TPU_SKIP_MDS_QUERY" not in environ else ""


def initialize(coordinator: str = "", processes: int | None = None, process_id: int | None = None) -> None:
    """Joins the processes that were started together; before anything asks jax for a device. Nothing on one host.

    Args:
        coordinator: HOST:PORT of process 0, as all can reach it. With none of the three, the cluster is asked
            (:func:`cluster`).
        processes: how many there are.
        process_id: which one this is, 0 … processes - 1.

    Raises:
        HostsError: an option is missing or out of range, or the processes do not find each other.
    """
    arguments = _arguments(coordinator, processes, process_id)
    if arguments is None:
        return
    # Else jax catches SIGTERM for itself, and a process that nobody has told how to stop does not stop.
    jax.config.update("jax_enable_preemption_service", False)
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(
            **arguments, initialization_timeout=JOIN_SECONDS, shutdown_timeout_seconds=SHUTDOWN_SECONDS
        )
    except (RuntimeError, ValueError) as error:
        if not coordinator and cluster(os.environ) == "tpu" and isinstance(error, ValueError):
            return  # libtpu is installed, but no TPU is here
        reason = first_line(error)
        raise LostHostError(
            f"process {process_id if coordinator else 'of a cluster'} cannot join the others ({reason}); start all "
            f"of them, with the same --coordinator and --processes, which all of them can reach"
        ) from error


def _arguments(coordinator: str, processes: int | None, process_id: int | None) -> dict[str, Any] | None:
    """Those of ``jax.distributed.initialize``; None where there is one process."""
    options = {"--coordinator": coordinator or None, "--processes": processes, "--process-id": process_id}
    missing = [name for name, value in options.items() if value is None]
    if len(missing) == len(options):
        found = cluster(os.environ)
        return None if not found else {} if found == "tpu" else {"cluster_detection_method": found}
    if missing or processes is None or process_id is None:
        raise HostsError(f"{' and '.join(missing)} missing; several hosts need {', '.join(options)}, or none of them")
    if not 0 <= process_id < processes:
        raise HostsError(f"--process-id is {process_id}; with --processes {processes} it is 0 … {processes - 1}")
    if not coordinator.rpartition(":")[2].isdigit() or not coordinator.rpartition(":")[0]:
        raise HostsError(f"--coordinator is {coordinator!r}; it is HOST:PORT of process 0")
    if processes == 1:
        return None
    # With detection off, a process keeps all its devices: Slurm's would leave it one.
    return {
        "coordinator_address": coordinator,
        "num_processes": processes,
        "process_id": process_id,
        "cluster_detection_method": "deactivate",
    }


def is_lead() -> bool:
    """Whether this process writes what is written once."""
    return jax.process_index() == 0


def barrier(name: str) -> None:
    """Waits until every process is here.

    Args:
        name: where, for the error.

    Raises:
        HostsError: another process is gone.
    """
    wait = multihost.get_barrier_sync_fn()
    try:
        wait(key=f"rsjax-{next(_numbers)}-{name}", timeout_ms=BARRIER_SECONDS * 1000)
    except jax.errors.JaxRuntimeError as error:
        raise LostHostError(
            f"another process was lost ({name}); its own message says why; start all of them again"
        ) from (error)


def agree(value: Any, name: str = "agree") -> Any:
    """The lead's ``value``, on every process; all of them have to ask.

    Args:
        value: JSON-ready. The others' is not looked at.
        name: as in :func:`barrier`.
    """
    if jax.process_count() == 1:
        return value
    barrier(name)  # a collective of the devices would not wait as long
    text = json.dumps(value).encode() if is_lead() else b""
    size = int(multihost_utils.broadcast_one_to_all(np.int32(len(text))))
    padded = np.zeros(-(-size // 256) * 256, np.uint8)  # of few sizes, as each is compiled
    padded[: len(text)] = np.frombuffer(text, np.uint8)
    return json.loads(bytes(multihost_utils.broadcast_one_to_all(padded))[:size])


def anywhere(flag: bool) -> bool:
    """Whether ``flag`` is set on any process: such as that one was told to stop. All of them have to ask."""
    return bool(np.any(multihost_utils.process_allgather(np.asarray(flag))))


def on_lead(name: str, work: Callable[[], None]) -> None:
    """Does ``work`` on the lead while the others wait; where it fails, all fail.

    Raises:
        HostsError: on the others, where it failed on the lead.
    """
    failure: BaseException | None = None
    if is_lead():
        try:
            work()
        except BaseException as error:
            if jax.process_count() == 1:
                raise
            failure = error
    told = agree(None if failure is None else f"{type(failure).__name__}: {failure}", name)
    if failure is not None:
        raise failure
    if told is not None:
        if told.startswith(f"{Preempted.__name__}: "):
            raise Preempted(told)
        raise HostsError(f"{name} failed on process 0 ({told})")
