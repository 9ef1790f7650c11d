"""Gives bad input to every command: each must end with one clear line and an exit status, without a traceback."""

import importlib
import json
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsjax.artifact import MARK
from rsjax.data.normalization import Normalization
from rsjax.data.token_sets import tokenizer_key, tokens_key
from rsjax.errors import UserError
from rsjax.files import write_file, write_json
from rsjax.runtime import HUGE_PAGES
from rsjax.tools.commands.cli import parse
from rsjax.tools.commands.train import Options
from rsjax.tools.pipeline.run import Run
from rsjax.training.checkpoint import Checkpoints, save_weights
from tests.tools.pipeline import toy

ROOT = Path(__file__).parents[1]
Answer = tuple[int, str, str]  # exit status, standard output, standard error
Command = Callable[..., Answer]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Returns a function that runs a command's main as its module does; an error that is no exit fails the test."""
    monkeypatch.setenv("GLIBC_TUNABLES", HUGE_PAGES)  # otherwise the process would restart itself
    monkeypatch.setattr("rsjax.tools.pipeline.stages._do", lambda *_: None)  # nothing is trained

    def call(line: str, *arguments: object) -> Answer:
        name, *words = line.split()
        monkeypatch.setattr(sys, "argv", [name, *words, *map(str, arguments)])
        try:
            importlib.import_module(f"experiments.{name}").main()
            status = 0
        except SystemExit as stop:
            status = int(stop.code or 0)
        printed = capsys.readouterr()
        return status, printed.out, printed.err

    return call


def assert_clear(answer: Answer, *words: str) -> None:
    """Asserts that the command was refused with one line of error that contains these words."""
    status, _, errors = answer
    assert status == 2, answer
    (line,) = [line for line in errors.splitlines() if not line.startswith("[")]  # notes of progress begin with a time
    assert line.startswith("error: "), answer
    assert all(word in line for word in words), answer


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a folder with a store of clips and a run on it whose stages are all marked as finished."""
    place = tmp_path_factory.mktemp("whole")
    store = toy.store(place / "store")
    config, _ = parse(["debug", "--store", str(place / "store")], "", "", Options())
    run = Run(config, place / "run", place / "data")
    run.prepare(overwrite=False)
    write_json(run.directory / "run.json", [{"time": "2026-01-01", "packages": {}, "data": {}, "code": {}}])
    toy.save_tokenizer(run)
    for stage in run.stages:
        with run.stage(stage) as folder:
            folder.mkdir(exist_ok=True)
    save_weights(run.output("world_model"), toy.world_model_params(config))
    shutil.copytree(store.path, run.output("tokens"))
    edit(run.output("tokens") / "manifest.json", key=_token_key(run))
    Normalization.create(store).save(run.directory / "tokens")
    for path in (run.output("evaluation"), run.output("report")):
        path.write_bytes(b"")
    write_json(run.directory / "metrics.json", {"psnr": 20.0})
    rows = [{"step": 1, "loss": 2.0}, {"step": 2, "loss": 1.0}]
    (run.directory / "world_model" / "log.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    row = {"step": 1, "loss": "nan", "grad_norm": "nan", "records": [], "data": {}}
    (run.directory / "world_model" / "skipped.jsonl").write_text(json.dumps(row) + "\n" + json.dumps(row) + "\n")
    return place


def _token_key(run: Run) -> str:
    assert run.config.data is not None
    return tokens_key(run.config.data.key, tokenizer_key(run.config.tokenizer, "None"))


def edit(path: Path, **fields: Any) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


@pytest.fixture
def place(whole: Path, tmp_path: Path) -> Path:
    """Returns a copy that a test can damage; its run refers to the store by the path in the original folder."""
    return shutil.copytree(whole, tmp_path / "copy", symlinks=True)


LINES = {
    "train": "train debug --store STORE --run-dir RUN",
    "generate": "generate RUN --store STORE --clips 999",
    "replay": "replay RUN --store STORE",
    "inspect": "inspect STORE --records 2 --clips 1 --sheet PLACE/sheet.png",
    "split": "store split STORE --into PLACE/parts --parts 2",
    "doctor": "doctor STORE",
}


def filled(line: str, place: Path) -> str:
    for word, path in {"STORE": place / "store", "RUN": place / "run", "PLACE": place}.items():
        line = line.replace(word, str(path))
    return line


def test_the_commands_work_on_what_is_whole(place: Path, command: Command) -> None:
    for name, line in LINES.items():
        status, out, errors = command(filled(line, place))
        assert (status, "no clip 999" in errors) == ((2, True) if name == "generate" else (0, False)), (out, errors)


WHOLE_FILES = {
    "empty": b"",
    "another type": b"3",
    "nested": b"[" * 100_000,
    "UTF-16": b"\xff\xfe{\x00}\x00",
    "a directory": None,
}
FILES = {  # files of a run and a store: the commands that read them, and those of them that refuse a damaged file
    "run/config.json": ("train generate replay", "generate replay"),
    "run/run.json": ("train", "train"),
    "run/tokens/units.json": ("train generate", "generate"),
    "run/tokens/store/manifest.json": ("train", ""),
    "run/world_model/skipped.jsonl": ("replay", ""),
    f"run/world_model/{MARK}": ("train", ""),
    "store/manifest.json": ("train inspect split doctor", "train inspect split doctor"),
}
VALUES = (3, ["x"], {"x": None}, float("inf"))


@pytest.mark.parametrize("file", FILES)
def test_a_damaged_file_of_a_run_or_store_is_named(file: str, place: Path, command: Command) -> None:
    path, (readers, refusers) = place / file, FILES[file]
    for payload in WHOLE_FILES.values():
        for name in readers.split():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
            if payload is None:
                path.mkdir()
            else:
                path.write_bytes(payload)
            answer = command(filled(LINES[name], place))
            if name in refusers.split():
                assert_clear(answer, path.name)
            elif answer[0]:
                assert_clear(answer)


@pytest.mark.parametrize("file", [file for file in FILES if file.endswith(".json")])
def test_a_field_of_another_type_brings_no_traceback(file: str, place: Path, command: Command) -> None:
    path = place / file
    intact = json.loads(path.read_text())
    names = list(intact[0] if isinstance(intact, list) else intact)
    for name in names:
        for number, value in enumerate(VALUES):
            content = json.loads(json.dumps(intact))
            (content[0] if isinstance(content, list) else content)[name] = value
            path.write_text(json.dumps(content))
            readers = FILES[file][0].split()
            answer = command(filled(LINES[readers[number % len(readers)]], place))
            if answer[0] not in (0, 1):  # with status 1, inspect and doctor report damage in their own words
                assert_clear(answer)


def test_a_line_of_another_type_in_the_log_is_named(place: Path, command: Command) -> None:
    path = place / "run" / "world_model" / "skipped.jsonl"
    good = path.read_text()
    for bad in ("[1]", "3", '{"step": "x"}', '{"loss": 1}', "[" * 100_000):
        path.write_text(f"{good}{bad}\n{good}")
        assert_clear(command(filled(LINES["replay"], place)), f"{path}: line 3 is damaged")
    path.write_text(good + '{"step": 1, "lo')
    assert command(filled(LINES["replay"], place))[0] == 0


def test_actions_that_are_no_npy_file_of_numbers_are_named(place: Path, command: Command) -> None:
    with (place / "archive.npy").open("wb") as file:
        np.savez(file, a=np.zeros((4, 28)))
    np.save(place / "objects.npy", np.array([None, {}], object), allow_pickle=True)
    (place / "directory.npy").mkdir()
    (place / "empty.npy").touch()
    for kind in ("archive", "objects", "directory", "empty"):
        path = place / f"{kind}.npy"
        assert_clear(command(filled(f"generate RUN --store STORE --actions {path}", place)), str(path))


OPTIONS = {
    "train debug --train.seed -1": "train.seed is -1; a seed is",
    "train debug --train.seed 4294967296": "train.seed is 4294967296; a seed is",
    "train debug --sim.seed 1180591620717411303424": "sim.seed is 1180591620717411303424",
    "train debug --train.optimizer.learning-rate nan": "optimizer.learning_rate is nan",
    "train debug --model.loss.depth-weight inf": "model.loss.depth_weight is inf",
    "train debug --model.depth small_branch --model.depth.width 24": "model.depth.width is 24; make it a multiple",
    "train debug --model.depth small_branch --model.depth.blocks 3": "model.depth.blocks is 3, which does not divide",
    "train debug --model.depth small_branch --model.depth.cells 5": "model.depth.cells is 5, which does not divide",
    "train debug --model.depth headed": "--model.depth is 'headed'; choose branch or small_branch or head or none",
    "train debug --processes 2 --process-id 0 --coordinator host:²": "--coordinator is",
    "train debug --runtime.profile -1": "runtime.profile is -1; it must be at least 0",
    "ablation debug --seeds -1": "--seeds is -1",
    "ablation debug --seeds 0 99999999999999999999": "seed",
    "generate RUN --fps nan": "--fps is nan",
    "generate RUN --scale 100000": "--scale is 100000",
    "generate RUN --seed 1180591620717411303424": "--seed is 1180591620717411303424",
    "generate RUN --guidance nan": "--guidance is nan",
    "generate RUN --clips 1180591620717411303424": "--clips",
    "doctor STORE --gap nan": "--gap is nan",
    "ingest sim STORE --test-share nan": "--test-share is nan",
    "play PLACE --no-browser": "not a run directory",
    "describe debug --train.seed -1": "train.seed is -1",
    "detect": "name videos or stores to judge, or runs to --train on",
    "detect a.mp4 --train runs/tiny": "name videos or stores to judge, or runs to --train on",
    "train debug --run-dir PLACE/new --eval.action-draws 99999999": "lower --eval.clips, --eval.rep",
    "train debug --eval.localiser-steps 99999999": "eval.localiser_steps is 99999999; it must be 1 … 100000",
    "bench debug --only sample --batch 99999999": "--batch is 99999999; it can be at most 10,000",
    "bench roboscape_s --only sample --batch 10000": "--batch 10000: so much at once takes more than",
    "bench debug --only sample --horizons 99999999": "--horizons is 99999999; it can be at most 10,000",
    "paper --preset debug --dry-run --seeds 99999999": "--seeds is 99999999; it must be 1 … 1000",
    "plan PLACE/run --energy tokens --candidates 99999999": "--candidates 99999999 and --horizon 12: so much at once",
    "plan PLACE/run --energy tokens --max-steps 99999999": "--max-steps is 99999999; it can be at most 10,000",
    "plan PLACE/run --energy tokens --rounds 99999999": "--rounds is 99999999; it can be at most 1,000",
    "synthesize PLACE/run --demos 99999999": "--demos is 99999999; it can be at most 1,000,000",
}


@pytest.mark.parametrize("line", OPTIONS)
def test_an_impossible_option_is_named(line: str, place: Path, command: Command) -> None:
    run = "RUN --store STORE --out PLACE/out"
    answer = command(filled(line.replace("RUN", run), place))
    assert_clear(answer, OPTIONS[line])
    assert "unknown argument" not in answer[2]


OUTPUTS = (
    "train debug --store STORE --run-dir OUT",
    "generate RUN --store STORE --clips 0 --frames 2 --out OUT",
    "ablation debug --store STORE --out OUT",
    "inspect STORE --records 2 --clips 1 --sheet OUT/sheet.png",
    "store split STORE --parts 2 --into OUT",
    "store merge OUT STORE PLACE/second",
    "bench debug --only matmul --json OUT/bench.json",
    "ingest sim STORE --out OUT --windows.frames 2 --option kind=delta",
)


@pytest.mark.parametrize("line", OUTPUTS)
def test_a_place_where_nothing_can_be_written_is_named(
    line: str, place: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rsjax.tools.bench.run.bench", lambda *_, keep, **__: keep({}))
    (place / "file").write_text("something")
    shutil.copytree(place / "store", place / "second")
    for out in (place / "file", Path("/proc/nowhere")):
        assert_clear(command(filled(line.replace("OUT", str(out)), place)), str(out.parent), out.name)
    assert (place / "file").read_text() == "something"


ENVIRONMENT = {
    "SLURM_NTASKS is 'many'": {"SLURM_STEP_NODELIST": "node[1-2]", "SLURM_NTASKS": "many"},
    "SLURM_NTASKS is '²'": {"SLURM_STEP_NODELIST": "node[1-2]", "SLURM_NTASKS": "²"},
    "OMPI_COMM_WORLD_SIZE is '-'": {"OMPI_MCA_orte_hnp_uri": "x", "OMPI_COMM_WORLD_SIZE": "-"},
    "MEGASCALE_NUM_SLICES is 'two'": {"TPU_WORKER_HOSTNAMES": "a", "MEGASCALE_NUM_SLICES": "two"},
    "SLURM_ARRAY_TASK_ID is '²'": {"SLURM_ARRAY_TASK_ID": "²"},
}


@pytest.mark.parametrize("message", ENVIRONMENT)
def test_variables_of_a_cluster_that_are_no_numbers_are_named(
    message: str, place: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    for key, value in ENVIRONMENT[message].items():
        monkeypatch.setenv(key, value)
    line = LINES["train"]
    if "ARRAY" in message:
        line = "ablation debug"
    assert_clear(command(filled(line, place)), message)


REFUSED = {
    "cuda": ("generate", "JAX_PLATFORMS", "JAX has no device for JAX_PLATFORMS=cuda; unset it"),
    "foo": ("train", "JAX_PLATFORMS", "JAX has no device for JAX_PLATFORMS=foo; unset it"),
    "maybe": ("train", "JAX_ENABLE_X64", "JAX_ENABLE_X64 is 'maybe', which jax does not know"),
    "many": ("generate", "JAX_NUM_CPU_DEVICES", "JAX_NUM_CPU_DEVICES is 'many', which jax does not know"),
}


def with_variable(line: str, name: str, value: str) -> Answer:
    """Runs a command in a separate process with an environment variable set."""
    command = [sys.executable, "-m", *f"experiments.{line}".split()]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {name: value}, capture_output=True, text=True)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("value", REFUSED)
def test_a_variable_that_jax_refuses_is_named(value: str, place: Path) -> None:
    command, name, message = REFUSED[value]
    assert_clear(with_variable(filled(LINES[command], place), name, value), message)


def test_figures_are_drawn_whatever_backend_the_environment_names(place: Path) -> None:
    answer = with_variable(filled(LINES["inspect"], place), "MPLBACKEND", "foo")
    assert answer[0] == 0, answer


def test_a_limit_on_the_size_of_files_is_named(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    state = {"w": np.random.default_rng(0).random(100_000)}
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, before[1]))
        with pytest.raises(UserError, match="larger than this process may write; raise the limit .ulimit -f"):
            save_weights(tmp_path / "weights", state)
        checkpoints = Checkpoints(tmp_path / "checkpoints")
        with pytest.raises(UserError, match="larger than this process may write; raise the limit .ulimit -f"):
            checkpoints.save(1, state, {})
        with pytest.raises(UserError, match="larger than this process may write"):
            write_file(tmp_path / "file", bytes(300_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
