"""Tests copying saved models through a server on this machine that answers as a hub does."""

import base64
import hashlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote

import jax
import numpy as np
import pytest

import rsjax
from rsjax.errors import UserError
from rsjax.models.trained import TrainedModel
from rsjax.tools.hub import pull, push
from tests.tools.pipeline import toy

pytest.importorskip("huggingface_hub")

ROOT = Path(__file__).parents[2]
COMMIT = "0123456789abcdef0123456789abcdef01234567"


class Hub(ThreadingHTTPServer):
    """Keeps the files of each repository in memory."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, dict[str, bytes]] = {}

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    """Answers the requests that making a repository, a commit and a snapshot need."""

    server: Hub

    def log_message(self, *_: object) -> None: ...

    def body(self) -> bytes:
        return self.rfile.read(int(self.headers.get("Content-Length") or 0))

    def answer(self, content: object, status: int = 200) -> None:
        payload = json.dumps(content).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(payload)))
        self.end_headers()
        self.wfile.write(payload)

    def do_POST(self) -> None:
        body = self.body()
        if self.path == "/api/repos/create":
            request = json.loads(body)
            name = "/".join(filter(None, (request.get("organization"), request["name"])))
            self.server.files.setdefault(name, {})
            self.answer({"url": f"{self.server.address}/{name}", "id": name, "name": name})
        elif self.path == "/api/validate-yaml":
            self.answer({"errors": [], "warnings": []})
        elif "/preupload/" in self.path:
            files = [{"path": file["path"], "uploadMode": "regular"} for file in json.loads(body)["files"]]
            self.answer({"files": [file | {"shouldIgnore": False} for file in files]})
        elif "/commit/" in self.path:
            name = "/".join(self.path.split("/")[3:5])
            for line in body.splitlines():
                entry = json.loads(line)
                if entry["key"] == "file":
                    content = base64.b64decode(entry["value"]["content"])
                    self.server.files[name][entry["value"]["path"]] = content
            url = f"{self.server.address}/{name}/commit/{COMMIT}"
            self.answer({"commitUrl": url, "commitOid": COMMIT, "success": True})
        else:
            self.answer({"error": f"POST {self.path}"}, 404)

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        parts = unquote(self.path.partition("?")[0]).strip("/").split("/")
        if parts[:2] == ["api", "models"] and "/".join(parts[2:4]) in self.server.files:
            name = "/".join(parts[2:4])
            siblings = [{"rfilename": file} for file in self.server.files[name]]
            if "tree" in parts:
                files = self.server.files[name]
                self.answer([{"type": "file", "path": p, "size": len(x), "oid": "0"} for p, x in files.items()])
                return
            self.answer({"id": name, "sha": COMMIT, "siblings": siblings, "private": False, "tags": [], "downloads": 0})
            return
        content = self.server.files.get("/".join(parts[:2]), {}).get("/".join(parts[4:]))
        if "resolve" not in parts or content is None:
            self.answer({"error": f"GET {self.path}"}, 404)
            return
        self.send_response(200)
        self.send_header("ETag", f'"{hashlib.sha256(content).hexdigest()}"')
        self.send_header("X-Repo-Commit", COMMIT)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(content)


@pytest.fixture
def hub() -> Iterator[Hub]:
    with Hub() as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> TrainedModel:
    return toy.trained(toy.store(tmp_path_factory.mktemp("hub") / "clips"))


def call(hub: Hub, folder: Path, *words: str) -> tuple[int, str]:
    """Runs the command in a process of its own, since the address is read when huggingface_hub is imported."""
    variables = {"HF_ENDPOINT": hub.address, "HF_TOKEN": "hf_local", "HF_HOME": str(folder / "home")}
    environment = os.environ | variables | {"PYTHONPATH": os.environ.get("PYTHONPATH", str(ROOT))}
    line = [sys.executable, "-m", "experiments.hub", *words]
    done = subprocess.run(line, cwd=ROOT, env=environment, capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


def test_a_pushed_model_is_pulled_as_it_was_and_a_damaged_one_is_refused(
    hub: Hub, model: TrainedModel, tmp_path: Path
) -> None:
    mine = tmp_path / "mine"
    model.save(mine)
    (mine / "notes.txt").write_text("stays here")
    (mine / "metrics.json").write_text("{}")  # as rsjax save writes it
    toy.store(mine / "clips")
    status, out = call(hub, tmp_path, "push", str(mine), "me/mine")
    assert (status, f"{hub.address}/me/mine/commit/{COMMIT}" in out) == (0, True), out
    files = hub.files["me/mine"]
    assert {"README.md", "config.json", "model.safetensors", "metrics.json", "clips/manifest.json"} <= files.keys()
    assert "notes.txt" not in files
    copy = tmp_path / "copy"
    status, out = call(hub, tmp_path, "pull", "me/mine", str(copy))
    assert status == 0, out
    jax.tree.map(np.testing.assert_array_equal, rsjax.load(copy).params, model.params)
    assert rsjax.open_store(copy / "clips").counts()["test"] == toy.TEST

    files["model.safetensors"] = files["model.safetensors"][:-1] + b"?"
    status, out = call(hub, tmp_path, "pull", "me/mine", str(copy))
    assert status == 2
    assert "model.safetensors: damaged: its SHA-256 is not the one that config.json records" in out
    rsjax.load(copy)  # is still the one from before


def test_refusals_name_what_is_wrong(model: TrainedModel, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    model.save(mine)
    refusals: tuple[tuple[Callable[[], object], str], ...] = (
        (lambda: push(mine, "no/such/name"), "no/such/name: the hub refused or could not be reached"),
        (lambda: pull("no/such/name", tmp_path / "copy"), "no/such/name: the hub refused or could not be reached"),
        (lambda: push(tmp_path, "me/mine"), "no saved model; make one of a run: rsjax save"),
        (lambda: pull("me/mine", tmp_path), "holds something else than a saved model"),
    )
    for refused, message in refusals:
        with pytest.raises(UserError) as caught:
            refused()
        assert message in str(caught.value)
