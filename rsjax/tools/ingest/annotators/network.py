"""What all networks share: loading once, torch and its kin, weights from local files, modules of a checkout."""

import importlib
import importlib.util
import sys
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

from rsjax.errors import first_line
from rsjax.files import file_versions, placeholder
from rsjax.tools.ingest.annotators.protocols import AnnotationError, Annotator

CHECKOUT = "checkout"  # the field of a folder of code, which a process imports once
EXTRA = "pip install 'rsjax[annotate]'"


@dataclass(frozen=True)
class NetworkAnnotator(Annotator):
    """Base class of the methods that run a network, which is loaded once per process, at the first call.

    Attributes:
        title: the network's name in messages.
        device: torch's name of it, such as "cpu" or "cuda".
    """

    title: ClassVar[str]
    device: str = field(default="cpu", kw_only=True)

    def load(self) -> Any:
        """Returns what :meth:`build` makes; errors as in :meth:`Annotator.load`."""
        named = [value for name, value in vars(self).items() if isinstance(value, Path) and name != CHECKOUT]
        return _build(self, tuple(map(file_versions, named)))

    def build(self) -> Any:
        """Makes the network from local files, ready for inference on ``device``."""
        raise NotImplementedError


@lru_cache(maxsize=5)  # one for each stage
def _build(network: NetworkAnnotator, versions: tuple[tuple[tuple[int, ...], ...], ...]) -> Any:
    library("torch", network.title)
    return network.build()


def library(name: str, what: str) -> Any:
    """Imports a module of the extra.

    Args:
        what: what needs it, for the message.

    Raises:
        AnnotationError: it is not installed, or does not go with the installed torch.
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
    """Imports a module of a repository that the user cloned, which runs its code.

    Raises:
        AnnotationError: it is missing, or does not import.
    """
    if not checkout.is_dir():
        raise AnnotationError(f"{checkout}: no such folder; {what} needs a checkout of its repository")
    entry = str(checkout.resolve())
    sys.path.insert(0, entry)
    try:
        module = importlib.import_module(name)
    except ImportError as error:
        raise AnnotationError(f"{checkout}: {name} does not import ({error}); check out {what} in it") from error
    finally:
        sys.path.remove(entry)
    # Checkouts call their packages "models" or "utils": one that was imported before would silently take their place.
    if not Path(module.__file__ or "").resolve().is_relative_to(checkout.resolve()):
        raise AnnotationError(f"{checkout}: {name} was imported from {module.__file__}; run {what} in its own process")
    return module


def require_weights(path: Path, what: str) -> None:
    """Raises :class:`AnnotationError` where a file of weights is missing, or something else is in its place."""
    if not path.is_file():
        raise AnnotationError(f"{path}: no such file; {what} needs its weights (nothing is downloaded)")
    if instead := placeholder(path):
        raise AnnotationError(f"{path}: {instead}")


def load_weights(model: Any, path: Path, device: str, what: str) -> Any:
    """Fills a torch model with the tensors of a local file, all of them and no others; returns it for inference.

    Raises:
        AnnotationError: the file is missing, damaged, or of another model, or the device is missing.
    """
    torch = library("torch", what)
    require_weights(path, what)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        model.load_state_dict(content.get("state_dict", content.get("model", content)))
    except Exception as error:  # torch reports damage as many types
        reason = first_line(error)
        raise AnnotationError(f"{path}: not the weights of {what} ({reason}); name the file that fits") from error
    return on_device(model, device, what)


def pretrained(kinds: tuple[str, str], path: Path, device: str, what: str, **options: Any) -> tuple[Any, Any]:
    """Loads a model and its processor, by their classes in ``transformers``, from a local folder only.

    Raises:
        AnnotationError: the folder is missing or does not contain them, or the device is missing.
    """
    transformers = library("transformers", what)
    for file in sorted(path.glob("*")):
        if instead := placeholder(file):
            raise AnnotationError(f"{file}: {instead}")
    if not (path / "config.json").is_file() and not (path / "preprocessor_config.json").is_file():
        raise AnnotationError(f"{path}: no model (config.json) in it; {what} needs one (nothing is downloaded)")
    if importlib.util.find_spec("torchvision"):  # processors use it if installed, and report a broken one badly
        library("torchvision", what)
    local: dict[str, Any] = {"local_files_only": True, "trust_remote_code": False}
    loaded = []
    for kind, more in zip(kinds, (options, {}), strict=True):
        try:
            loaded.append(getattr(transformers, kind).from_pretrained(path, **local, **more))
        except Exception as error:  # transformers reports missing or damaged files as many types
            reason = first_line(error)
            raise AnnotationError(f"{path}: {kind} cannot be made from it ({reason}); fetch the model again") from error
    return on_device(loaded[0], device, what), loaded[1]


def on_device(model: Any, device: str, what: str) -> Any:
    """Moves a model to a device, such as "cuda" or "cpu", and returns it for inference.

    Raises:
        AnnotationError: the device is missing.
    """
    try:
        return model.to(device).eval()
    except (RuntimeError, AssertionError) as error:  # torch asserts that it was built with CUDA
        reason = first_line(error)
        raise AnnotationError(f"{what} cannot use device {device!r} ({reason}); choose another, or cpu") from error
