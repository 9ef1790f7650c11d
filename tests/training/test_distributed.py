import json
import shlex
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from experiments.cli import parse
from experiments.train import Options
from rsjax.training import distributed
from rsjax.training.distributed import HostsError
from tests.training.test_placement import ROOT, virtual

Results = dict[str, Any]


def begin(folder: Path, devices: int, *address: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tests.training.hosts", str(folder), *address]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, env=virtual(devices), stdout=pipe, stderr=pipe, text=True)


def ended(process: subprocess.Popen[str]) -> Results:
    out, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    return json.loads(out.splitlines()[-1])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hosts")


@pytest.fixture(scope="module")
def results(folder: Path) -> list[Results]:
    """Of two processes with two devices each, and of one with one."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    pair = [begin(folder, 2, address, "2", str(number)) for number in range(2)]
    processes = [*pair, begin(folder / "alone", 1)]
    try:
        return [ended(process) for process in processes]
    finally:
        for process in processes:
            process.kill()  # where one failed, the other would wait for it


@pytest.mark.parametrize("way", ["pmap", "fsdp"])
def test_two_processes_train_as_one(way: str, results: list[Results], folder: Path) -> None:
    lead, other, alone = results
    losses = [result["trained"][way]["losses"] for result in (lead, other, alone)]
    assert losses[0] == losses[1]
    np.testing.assert_allclose(losses[0], losses[2], rtol=1e-5)
    ours, theirs = (np.load(folder / name) for name in (f"{way}-2.npz", f"alone/{way}-1.npz"))
    for name in theirs:
        np.testing.assert_allclose(ours[name], theirs[name], atol=1e-5)


def test_every_clip_knows_its_place_in_the_global_batch(results: list[Results]) -> None:
    assert [result["trained"]["fsdp"]["index"] for result in results] == [[0, 2, 4, 6], [1, 3, 5, 7], [*range(8)]]


def test_processes_see_their_own_devices_and_all(results: list[Results]) -> None:
    assert [result["told"]["devices"] for result in results] == [[2, 4], [2, 4], [1, 1]]


def test_all_hear_what_the_lead_says_and_whether_anyone_was_told_to_stop(results: list[Results]) -> None:
    for result in results[:2]:
        assert result["told"]["agree"] == {"from": 0, "text": "λ" * 300}
        assert result["told"]["anywhere"] == [True, False]
    assert results[2]["told"]["anywhere"] == [False, False]


def test_where_the_leads_work_fails_all_fail(results: list[Results]) -> None:
    failures = [result["told"]["failed"] for result in results]
    assert failures == ["no room", "a stage failed on process 0 (UserError: no room)", "no room"]


SLURM = {"SLURM_STEP_NODELIST": "n[1-2]", "SLURM_PROCID": "1"}


@pytest.mark.parametrize(
    ("environ", "name"),
    [
        ({}, ""),
        (SLURM | {"SLURM_NTASKS": "2"}, "slurm"),
        (SLURM | {"SLURM_NTASKS": "1"}, ""),
        ({"SLURM_JOB_ID": "7", "SLURM_NTASKS": "2"}, ""),  # a batch script outside srun
        ({"OMPI_MCA_orte_hnp_uri": "x", "OMPI_COMM_WORLD_SIZE": "2"}, "ompi"),
        ({"TPU_WORKER_HOSTNAMES": "a,b", "TPU_WORKER_ID": "0"}, "gketpu"),
        ({"TPU_WORKER_HOSTNAMES": "localhost", "TPU_WORKER_ID": "0"}, ""),
        ({"TPU_WORKER_HOSTNAMES": "a", "MEGASCALE_NUM_SLICES": "2"}, "gketpu"),
        ({"JOB_COMPLETION_INDEX": "0"}, ""),  # jax would ask for the kubernetes package
    ],
)
def test_the_cluster_is_known_by_what_it_sets(environ: Mapping[str, str], name: str) -> None:
    assert distributed.cluster(environ) == name


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("h:1", None, None), "--processes and --process-id missing; several hosts need"),
        (("", 2, 0), "--coordinator missing"),
        (("h:1", 2, 2), "--process-id is 2; with --processes 2 it is 0 … 1"),
        (("h", 2, 0), "--coordinator is 'h'; it is HOST:PORT"),
    ],
)
def test_options_that_cannot_be_are_refused(options: tuple[Any, ...], message: str) -> None:
    with pytest.raises(HostsError, match=message):
        distributed.initialize(*options)


def test_one_process_stays_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distributed.os, "environ", {})
    distributed.initialize()
    distributed.initialize("localhost:1", 1, 0)
    assert distributed.is_lead()
    distributed.barrier("nowhere")
    assert distributed.agree("this") == "this"


def test_the_launch_files_give_the_command_what_it_knows() -> None:
    job = list(yaml.safe_load_all((ROOT / "launch/kubernetes.yaml").read_text()))[1]["spec"]
    command = job["template"]["spec"]["containers"][0]["command"][-1].replace("$JOB_COMPLETION_INDEX", "1")
    program, *arguments = shlex.split(command.partition(" -m ")[2])
    assert program == "experiments.train"
    config, options = parse(arguments, program, "", Options())
    assert (config.train.placement, config.train.fsdp) == ("mesh", 8)
    assert (options.coordinator, options.processes, options.process_id) == ("rsjax-train-0.rsjax:8476", 2, 1)
    assert job["completions"] == job["parallelism"] == options.processes
    subprocess.run(["bash", "-n", ROOT / "launch/slurm.sbatch"], check=True)
