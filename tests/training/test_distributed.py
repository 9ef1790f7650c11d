import json
import shlex
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import yaml

from rsjax.tools.commands.cli import parse
from rsjax.tools.commands.train import Options
from rsjax.training import distributed
from rsjax.training.checkpoint import Checkpoints
from rsjax.training.distributed import HostsError
from tests.training.checkpoint_processes import state
from tests.training.test_sharding import ROOT, virtual

Results = dict[str, Any]
SLURM = {
    "SLURM_JOB_ID": "7",
    "SLURM_STEP_NODELIST": "n[1-2]",
    "SLURM_NTASKS": "2",
    "SLURM_PROCID": "0",
    "SLURM_LOCALID": "0",
}


def start(folder: Path, devices: int, *address: str, **environ: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tests.training.hosts", str(folder), *address]
    pipe, environment = subprocess.PIPE, virtual(devices) | environ
    return subprocess.Popen(command, cwd=ROOT, env=environment, stdout=pipe, stderr=pipe, text=True)


def result(process: subprocess.Popen[str]) -> Results:
    out, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    *notes, last = out.splitlines()
    return json.loads(last) | {"notes": notes}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hosts")


@pytest.fixture(scope="module")
def results(folder: Path) -> list[Results]:
    """Of two processes with two devices each, and of one with one device.

    Process 0 gets the address from its environment, as a Slurm task, and process 1 as arguments.
    """
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    slurm = SLURM | {"SLURM_STEP_NODELIST": "localhost,other", "JAX_COORDINATOR_PORT": port}
    pair = [start(folder, 2, **slurm), start(folder, 2, f"localhost:{port}", "2", "1")]
    processes = [*pair, start(folder / "alone", 1)]
    try:
        return [result(process) for process in processes]
    finally:
        for process in processes:
            process.kill()  # where one failed, the other would wait for it


@pytest.mark.parametrize("kind", ["pmap", "fsdp"])
def test_two_processes_train_as_one(kind: str, results: list[Results], folder: Path) -> None:
    lead, other, alone = results
    losses = [result["trained"][kind]["losses"] for result in (lead, other, alone)]
    assert losses[0] == losses[1]
    np.testing.assert_allclose(losses[0], losses[2], rtol=1e-5)
    ours, theirs = (np.load(folder / name) for name in (f"{kind}-2.npz", f"alone/{kind}-1.npz"))
    for name in theirs:
        np.testing.assert_allclose(ours[name], theirs[name], atol=1e-5)


def test_two_processes_save_checkpoints_together_and_one_reads_them(results: list[Results], folder: Path) -> None:
    damaged = "checkpoint 3 is damaged (data/metadata: No such file or directory)"
    assert [sum(damaged in note for note in result["notes"]) for result in results] == [1, 0, 0]
    saved = state(4)
    checkpoints = Checkpoints(folder / "checkpoints")
    restored, data = checkpoints.restore(jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), saved))
    checkpoints.close()
    assert data == {"next": 4}
    jax.tree.map(np.testing.assert_array_equal, restored, saved)


def test_every_clip_knows_its_place_in_the_global_batch(results: list[Results]) -> None:
    assert [result["trained"]["fsdp"]["index"] for result in results] == [[0, 2, 4, 6], [1, 3, 5, 7], [*range(8)]]


def test_processes_see_all_devices_get_the_leads_value_and_stop_and_fail_together(results: list[Results]) -> None:
    exchanged = [result["exchanged"] for result in results]
    assert [each["devices"] for each in exchanged] == [[2, 4], [2, 4], [1, 1]]
    assert [each["agree"] for each in exchanged[:2]] == [{"from": 0, "text": "λ" * 300}] * 2
    assert [each["anywhere"] for each in exchanged] == [[True, False], [True, False], [False, False]]
    failures = [each["failed"] for each in exchanged]
    assert failures == ["no room", "a stage failed on process 0 (UserError: no room)", "no room"]


@pytest.mark.parametrize(
    ("environ", "several"),
    [
        ({}, False),
        (SLURM, True),
        (SLURM | {"SLURM_NTASKS": "1"}, False),
        ({"SLURM_JOB_ID": "7", "SLURM_NTASKS": "2"}, False),  # a batch script outside srun
        ({"OMPI_MCA_orte_hnp_uri": "x", "OMPI_COMM_WORLD_SIZE": "2"}, True),
        ({"TPU_WORKER_HOSTNAMES": "a,b", "TPU_WORKER_ID": "0"}, True),
        ({"TPU_WORKER_HOSTNAMES": "localhost", "TPU_WORKER_ID": "0"}, False),
        ({"TPU_WORKER_HOSTNAMES": "a", "MEGASCALE_NUM_SLICES": "2"}, True),
        ({"JOB_COMPLETION_INDEX": "0"}, False),  # jax would need the kubernetes package
    ],
)
def test_launchers_are_recognized_by_their_environment_variables(environ: Mapping[str, str], several: bool) -> None:
    assert distributed.has_peers(environ) == several


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("h:1", None, None), "--processes and --process-id missing; several hosts need"),
        (("", 2, 0), "--coordinator missing"),
        (("h:1", 2, 2), "--process-id is 2; with --processes 2 it is 0 … 1"),
        (("h", 2, 0), "--coordinator is 'h'; it is HOST:PORT"),
    ],
)
def test_contradictory_options_are_refused(options: tuple[Any, ...], message: str) -> None:
    with pytest.raises(HostsError, match=message):
        distributed.initialize(*options)


def test_one_process_stays_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distributed.os, "environ", {})
    distributed.initialize()
    distributed.initialize("localhost:1", 1, 0)
    assert distributed.is_lead()
    distributed.barrier("nowhere")
    assert distributed.agree("this") == "this"


def test_the_launch_files_use_options_of_the_command() -> None:
    job = list(yaml.safe_load_all((ROOT / "launch/kubernetes.yaml").read_text()))[1]["spec"]
    command = job["template"]["spec"]["containers"][0]["command"][-1].replace("$JOB_COMPLETION_INDEX", "1")
    start, program, action, *arguments = shlex.split(command)
    assert (start, program, action) == ("exec", "rsjax", "train")
    config, options = parse(arguments, program, "", Options())
    assert (config.runtime.sharding, config.runtime.fsdp) == ("mesh", 8)
    assert (options.coordinator, options.processes, options.process_id) == ("rsjax-train-0.rsjax:8476", 2, 1)
    assert job["completions"] == job["parallelism"] == options.processes


@pytest.mark.parametrize(
    ("status", "restarts", "queued"),
    [(0, 0, False), (75, 99, True), (1, 0, False), (2, 0, False), (134, 19, True), (134, 20, False)],
)
def test_the_job_is_queued_again_where_that_helps(tmp_path: Path, status: int, restarts: int, queued: bool) -> None:
    for name, act in (("srun", f"exit {status}"), ("scontrol", f"touch {tmp_path}/queued")):
        (tmp_path / name).write_text(f"#!/bin/bash\n{act}\n")
        (tmp_path / name).chmod(0o755)
    environ = {"PATH": f"{tmp_path}:/usr/bin:/bin", "SLURM_RESTART_COUNT": str(restarts), "SLURM_JOB_ID": "1"}
    job = subprocess.run(["bash", ROOT / "launch/slurm.sbatch", "experiments.train", "debug"], env=environ)
    assert (job.returncode, (tmp_path / "queued").exists()) == (status, queued)
