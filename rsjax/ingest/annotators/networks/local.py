"""What the adapters share: torch and its kin, weights from local files, and modules of a checkout."""

import importlib
import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rsjax.errors import first_line
from rsjax.ingest.annotators.protocols import AnnotationError

EXTRA = "pip install 'rsjax[annotate]'"


def library(name: str, what: str) -> Any:
    """A module of the extra.

    Args:
        what: what needs it, for the message.

    Raises:
        AnnotationError: it is not installed, or does not go with the torch that is.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise AnnotationError(f"{what} needs {name} ({error}); install it ({EXTRA}), or take the default") from error
    except (RuntimeError, OSError, AttributeError) as error:  # what a torchvision of another torch raises, by version
        raise AnnotationError(
            f"{what} needs {name}, which does not import ({first_line(error)}); torchvision has to be of the same "
            f"release and build as torch: install both again together"
        ) from error


def checkout_module(checkout: Path, name: str, what: str) -> Any:
    """A module of a repository that the user cloned, which runs its code.

    Raises:
        AnnotationError: it is not there, or does not import.
    """
    if not checkout.is_dir():
        raise AnnotationError(f"{checkout}: no such folder; {what} needs a checkout of its repository")
    with _path_first(checkout):
        try:
            module = importlib.import_module(name)
        except ImportError as error:
            raise AnnotationError(f"{checkout}: {name} does not import ({error}); check out {what} there") from error
    # Checkouts name their packages "models" or "utils": another one's, imported before, would be taken silently.
    if not Path(module.__file__ or "").resolve().is_relative_to(checkout.resolve()):
        raise AnnotationError(f"{checkout}: {name} was imported from {module.__file__}; run {what} in its own process")
    return module


@contextmanager
def _path_first(folder: Path) -> Iterator[None]:
    entry = str(folder.resolve())
    sys.path.insert(0, entry)
    try:
        yield
    finally:
        sys.path.remove(entry)


def load_weights(model: Any, path: Path, what: str) -> Any:
    """Puts the tensors of a local file into a torch model, all of them and no others; returns it for inference.

    Raises:
        AnnotationError: no such file, damaged, or of another model.
    """
    torch = library("torch", what)
    if not path.is_file():
        raise AnnotationError(f"{path}: no such file; {what} needs its weights there (nothing is downloaded)")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        state = content.get("state_dict", content.get("model", content))
        model.load_state_dict(state)
    except Exception as error:  # torch reports damage as many types
        told = first_line(error)
        raise AnnotationError(
            f"{path}: not the weights of {what} ({told}); give the file that belongs to it"
        ) from error
    return model.eval()


def pretrained(kind: str, path: Path, what: str, **options: Any) -> Any:
    """``transformers.<kind>.from_pretrained`` of a local folder, and of nothing else.

    Raises:
        AnnotationError: no such folder, or it does not hold one.
    """
    transformers = library("transformers", what)
    if not (path / "config.json").is_file() and not (path / "preprocessor_config.json").is_file():
        raise AnnotationError(f"{path}: holds no model (config.json); {what} needs it there (nothing is downloaded)")
    if importlib.util.find_spec("torchvision"):  # processors use it where it is, and tell nothing useful of one amiss
        library("torchvision", what)
    local: dict[str, Any] = {"local_files_only": True, "trust_remote_code": False}
    try:
        return getattr(transformers, kind).from_pretrained(path, **local, **options)
    except Exception as error:  # transformers reports what is missing or damaged as many types
        told = first_line(error)
        raise AnnotationError(f"{path}: {kind} cannot be made from it ({told}); fetch the whole model again") from error


def on_device(model: Any, device: str, what: str) -> Any:
    """The model on a device, such as "cuda" or "cpu".

    Raises:
        AnnotationError: there is none.
    """
    try:
        return model.to(device)
    except (RuntimeError, AssertionError) as error:  # torch asserts that it was built with CUDA
        told = first_line(error)
        raise AnnotationError(
            f"device {device!r} cannot be used for {what} ({told}); choose another, or cpu"
        ) from error
