"""The files for contributors: they can be read, and what they name is there."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
YAML = [
    ROOT / ".pre-commit-config.yaml",
    ROOT / "CITATION.cff",
    *sorted((ROOT / ".github").rglob("*.yml")),
]


def load(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


def targets() -> set[str]:
    """Returns the Makefile's targets."""
    return set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))


def made(script: str) -> list[str]:
    """Returns the targets that a script makes."""
    return re.findall(r"\bmake ([a-z-]+)", script)


@pytest.mark.parametrize("path", YAML, ids=lambda path: path.name)
def test_yaml_files_can_be_read(path: Path) -> None:
    assert load(path)


def test_workflows_call_targets_that_exist_and_pin_their_actions() -> None:
    for path in sorted((ROOT / ".github" / "workflows").glob("*.yml")):
        for name, job in load(path)["jobs"].items():
            assert "timeout-minutes" in job, f"{path.name}: {name}"
            for step in job["steps"]:
                assert re.fullmatch(r"actions/[a-z-]+@v\d+", step.get("uses", "actions/checkout@v6"))
                for target in made(step.get("run", "")):
                    assert target in targets(), f"{path.name}: make {target}"


def test_the_workflow_has_the_checks_that_a_change_must_pass() -> None:
    jobs = load(ROOT / ".github" / "workflows" / "ci.yml")["jobs"]
    assert {"lint", "test", "wheel", "docs"} <= jobs.keys()
    assert jobs["test"]["strategy"]["matrix"]["python"] == ["3.11", "3.12"]


def test_the_local_run_checks_what_the_workflow_does() -> None:
    jobs = load(ROOT / ".github" / "workflows" / "ci.yml")["jobs"]
    wanted = {target for job in jobs.values() for step in job["steps"] for target in made(step.get("run", ""))}
    assert {"lint", "test", "wheel-test", "docs"} <= wanted <= set(made((ROOT / ".ci" / "run").read_text()))


def test_hooks_and_containers_use_what_is_there() -> None:
    hooks = [hook for repo in load(ROOT / ".pre-commit-config.yaml")["repos"] for hook in repo["hooks"]]
    assert {"ruff", "ruff-format", "mypy", "ratchets"} <= {hook["id"] for hook in hooks}
    container = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text())
    assert container["postCreateCommand"].removeprefix("make ") in targets()
    text = (ROOT / "Dockerfile").read_text()
    stages = re.findall(r"^FROM \S+ AS (\w+)$", text, re.MULTILINE)
    assert {"cpu", "cuda"} <= set(stages)
    extras = re.findall(r'"\.\[([a-z0-9,]+)\]"', text)
    settings = (ROOT / "setup.cfg").read_text()
    for extra in {name for group in extras for name in group.split(",")}:
        assert re.search(rf"^{extra} ?=", settings, re.MULTILINE), extra
    for line in re.findall(r"^COPY (.*) \S+$", text, re.MULTILINE):
        assert all((ROOT / name).exists() for name in line.split())
