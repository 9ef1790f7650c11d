"""Copies saved models to and from a hub that huggingface_hub speaks with, as they are (extra ``hub``)."""

import importlib
import tempfile
from pathlib import Path
from typing import Any

from rsjax.errors import UserError, first_line
from rsjax.files import disk_guard, replace_directory
from rsjax.model_directory import CARD, CLIPS, SETTINGS, TENSORS, check_digests, is_saved

FILES = (SETTINGS, TENSORS, CARD, "metrics.json", f"{CLIPS}/*")


class HubError(UserError):
    """A hub refused, or could not be reached."""


def push(directory: Path, repository: str, private: bool = False) -> str:
    """Uploads a saved model, whose digests are checked first; the repository is made if it is missing.

    Args:
        repository: ``USER/NAME``. The account is that of ``hf auth login`` or of the variable ``HF_TOKEN``.

    Returns:
        The address of the commit.

    Raises:
        UserError: the directory is not a saved model or is damaged, or the hub refuses.
    """
    if not is_saved(directory):
        raise UserError(f"{directory}: no saved model; make one of a run: rsjax save {directory} NAME")
    check_digests(directory)
    api = _hub().HfApi()
    try:
        api.create_repo(repository, private=private, exist_ok=True)
        commit = api.upload_folder(repo_id=repository, folder_path=directory, allow_patterns=list(FILES))
    except Exception as error:  # of httpx, of the hub, of its own checks of names
        raise _failed(repository, error) from error
    return str(commit.commit_url)


def pull(repository: str, out: Path, revision: str | None = None) -> None:
    """Downloads a saved model and checks its digests; an older one at ``out`` is replaced when the new one is whole.

    Args:
        repository: ``USER/NAME``.
        revision: a branch, tag or commit; None: the newest.

    Raises:
        UserError: ``out`` holds something else, the hub refuses, or what it has is not a saved model or damaged.
    """
    if out.exists() and not is_saved(out) and any(out.iterdir()):
        raise UserError(f"{out}: holds something else than a saved model; choose another place")
    hub = _hub()
    with disk_guard(out):
        out.absolute().parent.mkdir(parents=True, exist_ok=True)
        folder = tempfile.TemporaryDirectory(dir=out.absolute().parent, prefix=f".{out.name}.")
    with folder as place:
        new = Path(place) / out.name
        try:
            hub.snapshot_download(repository, revision=revision, local_dir=new, allow_patterns=list(FILES))
        except Exception as error:  # as above
            raise _failed(repository, error) from error
        if not is_saved(new):
            raise HubError(f"{repository}: holds no {TENSORS}, so it is not a saved model")
        check_digests(new)
        with disk_guard(out):
            replace_directory(new, out.absolute())


def _hub() -> Any:
    try:
        return importlib.import_module("huggingface_hub")
    except ImportError:
        raise UserError("huggingface_hub is not installed; pip install 'rsjax[hub]' installs it") from None


def _failed(repository: str, error: Exception) -> HubError:
    return HubError(f"{repository}: the hub refused or could not be reached ({first_line(error)}); see hf auth whoami")
