"""Counts the least time that an optimised program needs on a card: its roofline time.

Each kernel takes at least as long as its bytes at the memory's bandwidth, and as its operations at the peak; the
roofline time is the sum over all kernels, those of loops times their iterations. A fusion reads its operands and writes
its results once; of an operand that it only slices it reads the slice, and of an array that it updates in place it
writes the update. Operations are those of matrix products and convolutions. Arrays that a TPU keeps on the chip cost
nothing; those in its memory are counted with their padding.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import prod
from typing import NamedTuple

import numpy as np

from rsjax.layers.kernel_flops import KERNELS, kernel_flops
from rsjax.tools.compile.cards import Card
from rsjax.tools.compile.hlo import HOST, Array, Computation, Instruction, Module, parse

# Instructions without a kernel. Those that end an asynchronous operation are counted where it starts.
FREE = {
    "parameter", "constant", "tuple", "get-tuple-element", "bitcast", "after-all", "add-dependency", "domain",
    "partition-id", "replica-id", "opt-barrier", "optimization-barrier", "copy-done", "slice-done", "async-done",
    "async-update", "fusion-done", "all-reduce-done", "all-gather-done", "collective-permute-done", "send-done",
    "recv-done",
}  # fmt: skip
# Custom calls without a kernel.
FREE_CALLS = {
    "AllocateBuffer", "AssumeGatherIndicesInBound", "GatherScatterIndicesBitpacked", "ConcatBitcast", "Sharding",
    "SPMDFullToShardShape", "SPMDShardToFullShape", "annotate_device_placement",
}  # fmt: skip
# Custom calls that only move data, or whose operations are few beside their bytes. The one without a name is a gather
# that a TPU's SparseCore does.
PLAIN_CALLS = {
    "TopK",
    "__cub$DeviceRadixSort",
    "xla.gpu.ext.cub_sort_unassigned_scratch_size",
    "__gpu$TopK",
    "TODO(b/522284627)",
}
COLLECTIVES = ("all-reduce", "all-gather", "reduce-scatter", "all-to-all", "collective-permute", "ragged-all-to-all")
# Names in an operation's path that are not modules of the model.
_WRAPPERS = {
    "while",
    "body",
    "cond",
    "closed_call",
    "checkpoint",
    "shard_map",
    "rematted_computation",
    "train_step",
    "pallas_call",
    "",
}
# Inside a fusion, these compute each element of the result from one element of their operand.
UNARY = {"bitcast", "convert", "copy", "reshape", "transpose"}


class ProductCost(NamedTuple):
    """Products of matrices: operations, and the seconds that they take at the peak of their number format."""

    flops: float = 0
    seconds: float = 0

    def __add__(self, other: "ProductCost") -> "ProductCost":  # type: ignore[override]
        return ProductCost(self.flops + other.flops, self.seconds + other.seconds)


@dataclass(frozen=True)
class Kernel:
    """A kernel of a program.

    Attributes:
        opcode: of its instruction; for a custom call its target.
        op_name: the path in the traced Python program of the operation that gave the fusion its name.
        launches: how often it runs in one execution of the program.
        bytes: that it moves between the chip and the memory in one launch.
        flops: operations of one launch.
        seconds: the least time of one launch.
        sent: bytes that a collective hands to other devices in one launch; 0 for other kernels.
        exposed: seconds of one launch of a collective, at the links' bandwidth, in which no kernel runs beside it.
    """

    name: str
    opcode: str
    op_name: str
    launches: int
    bytes: float
    flops: float
    seconds: float
    sent: float = 0
    exposed: float = 0

    @property
    def total(self) -> float:
        """Seconds of all launches."""
        return self.launches * self.seconds


@dataclass(frozen=True)
class Roofline:
    """The kernels of a program, and warnings about parts whose cost is not known."""

    kernels: tuple[Kernel, ...]
    warnings: tuple[str, ...]

    @property
    def seconds(self) -> float:
        """The roofline time."""
        return sum(kernel.total for kernel in self.kernels)

    @property
    def exposed(self) -> float:
        """Seconds that collectives add to it, because no kernel runs beside them."""
        return sum(kernel.launches * kernel.exposed for kernel in self.kernels)

    @property
    def bytes(self) -> float:
        """Bytes between chips and memory."""
        return sum(kernel.launches * kernel.bytes for kernel in self.kernels)

    @property
    def flops(self) -> float:
        """Operations."""
        return sum(kernel.launches * kernel.flops for kernel in self.kernels)

    @property
    def launches(self) -> int:
        """The number of kernels that run."""
        return sum(kernel.launches for kernel in self.kernels)

    def collectives(self) -> dict[str, tuple[int, float]]:
        """Returns the number of launches and the bytes sent of each kind of collective."""
        kinds: dict[str, tuple[int, float]] = {}
        for kernel in self.kernels:
            if kernel.sent:
                launches, sent = kinds.get(kernel.opcode, (0, 0.0))
                kinds[kernel.opcode] = (launches + kernel.launches, sent + kernel.launches * kernel.sent)
        return kinds

    def by_part(self, part: Callable[[str], str]) -> dict[str, "Roofline"]:
        """Groups the kernels by ``part(op_name)``, the most expensive group first."""
        groups: dict[str, list[Kernel]] = {}
        for kernel in self.kernels:
            groups.setdefault(part(kernel.op_name), []).append(kernel)
        parts = {name: Roofline(tuple(kernels), ()) for name, kernels in groups.items()}
        return dict(sorted(parts.items(), key=lambda item: -item[1].seconds))


def roofline(text: str, card: Card, local: int = 8) -> Roofline:
    """Returns the cost of a program on one device.

    Args:
        text: of the optimised program, ``compiled.as_text()``.
        local: devices of a host.
    """
    module = parse(text)
    counter = _Counter(module, card, local)
    kernels = tuple(counter.kernels(module[module.entry]))
    return Roofline(kernels, tuple(dict.fromkeys(counter.warnings)))


def part_of(op_name: str, depth: int = 3) -> str:
    """Returns the part of the model that an operation belongs to, such as ``backward blocks/rgb/spatial_attn``.

    Args:
        depth: the most names of a part.
    """
    phase = ""
    if "rematted_computation" in op_name:
        phase = "recomputed "
    elif "transpose(" in op_name:
        phase = "backward "
    elif "jvp(" in op_name:
        phase = "forward "
    path = re.sub(r"\b\w+\(|\)", "", op_name)  # jit(step)/jvp(Network)/layer: step/Network/layer
    modules = [name.partition(".")[0] for name in path.split("/")[1:-1]]
    modules = [name for name in modules if name not in _WRAPPERS and not re.match(r"[A-Z]|_|branch_\d|.*->", name)]
    names = [name for name, before in zip(modules, [None, *modules], strict=False) if name != before]
    part = "/".join(names[:depth])
    if not part and "while/body" in op_name:
        part = "the loop over blocks"
    elif not part and "train_step" in op_name:
        part = {"": "optimizer"}.get(phase, "loss and masks")
    return f"{phase}{part or 'other'}"


class _Counter:
    """Counts the kernels of one program on one card."""

    def __init__(self, module: Module, card: Card, local: int) -> None:
        self.module = module
        self.card = card
        self.local = local
        self.warnings: list[str] = []

    def kernels(self, computation: Computation, times: int = 1) -> list[Kernel]:
        """Returns the kernels of a computation that runs ``times`` times."""
        kernels: list[Kernel] = []
        started: dict[str, int] = {}  # the number of kernels before each collective that runs beside others
        for one in computation:
            if one.opcode.endswith("-done") and one.operands[0] in started:
                start = started.pop(one.operands[0])
                beside = sum(kernel.total for kernel in kernels[start + 1 :]) / times
                exposed = max(0.0, kernels[start].exposed - beside)
                kernels[start] = replace(kernels[start], exposed=exposed)
            new = self._run(one, computation, times)
            if new and new[0].sent:
                started[one.name] = len(kernels)
            kernels += new
        return kernels

    def _run(self, one: Instruction, computation: Computation, times: int) -> list[Kernel]:
        """Returns the kernels of an instruction."""
        # A TPU's scalar unit computes what has no axes.
        scalar = self.card.platform == "tpu" and one.opcode != "fusion" and all(not x.dims for x in one.arrays)
        if one.opcode in FREE or (one.opcode == "custom-call" and _target(one) in FREE_CALLS) or scalar:
            return []
        if one.opcode == "while":
            return self.kernels(self.module[one.called[0]], times * self._trips(one))
        if one.opcode == "conditional":
            branches = [self.kernels(self.module[name], times) for name in one.called]
            return max(branches, key=lambda branch: sum(kernel.total for kernel in branch))
        if one.opcode in ("call", "async-start"):
            return [kernel for name in one.called for kernel in self.kernels(self.module[name], times)]
        if one.opcode == "fusion-start":  # a fusion beside others; its results lie between its operands and a context
            given = sum(len(computation[name].arrays) for name in one.operands)
            one = replace(one, opcode="fusion", arrays=one.arrays[given:-1])
        return [replace(self._kernel(one, computation), launches=times)]

    def _trips(self, loop: Instruction) -> int:
        """Returns the iterations of a loop: those that XLA found, or the constant in its condition."""
        known = re.search(r'known_trip_count"?:\s*\{"?n"?:\s*"?(\d+)', loop.attributes)
        if known:
            return int(known[1])
        condition = self.module[loop.attribute("condition").lstrip("%")]
        constants = [one for one in self._inside(condition) if one.opcode == "constant" and one.argument.isdigit()]
        limits = [int(one.argument) for one in constants if one.arrays[0].dtype in ("s32", "u32", "s64")]
        if len(limits) == 1:
            return limits[0]
        self.warnings.append(f"{loop.name}: a loop of an unknown number of iterations, counted once")
        return 1

    def _inside(self, computation: Computation) -> Iterator[Instruction]:
        """Yields the instructions of a computation and of the fusions in it."""
        for one in computation:
            yield one
            if one.opcode == "fusion":
                yield from self._inside(self.module[one.called[0]])

    def _kernel(self, one: Instruction, computation: Computation) -> Kernel:
        opcode = one.opcode
        operands = [computation[name] for name in dict.fromkeys(one.operands)]
        results = sum(map(self._bytes, one.arrays))
        sent = 0.0
        transfer = 0.0
        work = ProductCost()
        collective = next((kind for kind in COLLECTIVES if opcode.startswith(kind)), None)
        if opcode == "fusion":
            inner = self.module[one.called[0]]
            moved = self._fusion_bytes(one, computation, inner)
            work = self._products(inner)
        elif collective:
            opcode = collective
            sources = [x for operand in operands for x in operand.arrays]
            targets = one.arrays
            if one.opcode.endswith("-start") and collective != "all-reduce":
                targets = targets[len(sources) :]  # its results begin with its operands
            moved = sum(map(self._bytes, [*sources, *targets]))
            payload = max(sum(x.bytes for x in sources), sum(x.bytes for x in targets))
            sent, transfer = self._transfer(collective, one, payload)
        elif opcode in ("copy-start", "slice-start"):
            target = one.arrays[{"copy-start": 0, "slice-start": -2}[opcode]]
            source = operands[0].arrays[0]
            moved = self._bytes(target) + self._bytes(replace(target, space=source.space))
        elif opcode in ("slice", "dynamic-slice", "gather"):
            moved = results + sum(self._bytes(replace(x, space=operands[0].arrays[0].space)) for x in one.arrays)
        elif opcode == "dynamic-update-slice":
            moved = 2 * self._bytes(computation[one.operands[1]].arrays[0])
        elif opcode == "scatter":
            moved = 3 * self._bytes(computation[one.operands[-1]].arrays[0])
        elif opcode == "custom-call":
            opcode = _target(one)
            read = sum(self._operand_bytes(x) for x in operands)
            moved = read + sum(self._bytes(x) for x in one.arrays if x.dtype not in ("u8", "s8"))  # workspaces
            work = self._call(one, computation)
        else:
            moved = results + sum(self._operand_bytes(x) for x in operands)
            work = self._product(one, computation)
        seconds = max(moved / self.card.bandwidth, work.seconds)
        exposed = max(0.0, transfer - seconds)
        return Kernel(one.name, opcode, one.op_name, 1, float(moved), work.flops, seconds, sent, exposed)

    def _transfer(self, kind: str, one: Instruction, payload: float) -> tuple[float, float]:
        """Returns the bytes that each device sends in a collective, and the least seconds for them.

        Within a host they go over the cards' links. Between hosts, the data that all members on a host have to send go
        over the network adapters of these members.
        """
        group = _group(one)
        hosts = len({device // self.local for device in group})
        members = len(group) / hosts
        if kind == "collective-permute":
            pairs = zip(*[iter(one.integers("source_target_pairs"))] * 2, strict=True)
            far = any(source // self.local != target // self.local for source, target in pairs)
            speed = self.card.link
            if far:
                speed = self.card.network
            return payload, payload / speed
        passes = 1 + (kind == "all-reduce")
        sent = passes * payload * (1 - 1 / len(group))
        between = passes * payload * (1 - 1 / hosts) / (members * self.card.network)
        return sent, max(sent / self.card.link, between)

    def _bytes(self, array: Array) -> int:
        """Returns the array's bytes in the device's memory."""
        on_chip = self.card.platform == "tpu" and array.space not in (0, HOST)
        return array.bytes * (not on_chip)

    def _operand_bytes(self, operand: Instruction) -> int:
        return sum(map(self._bytes, operand.arrays))

    def _fusion_bytes(self, one: Instruction, computation: Computation, inner: Computation) -> float:
        names: dict[str, list[Instruction]] = {}
        for number, name in enumerate(one.operands):
            names.setdefault(name, []).append(inner.parameters[number])
        moved = 0.0
        for name, parameters in names.items():
            share = min(1.0, sum(self._read_share(inner, parameter) for parameter in parameters))
            moved += share * self._operand_bytes(computation[name])
        for share, array in zip(self._written_shares(inner), one.arrays, strict=True):
            moved += share * self._bytes(array)
        return moved

    def _read_share(self, inner: Computation, value: Instruction) -> float:
        """Returns the share of a value's elements that a fusion reads."""
        size = sum(x.size for x in value.arrays)
        if not size:
            return 0
        if value.name == inner.root:
            return 1
        read = 0.0
        for user in inner.users[value.name]:
            first = user.operands[0] == value.name
            if first and user.opcode in ("slice", "dynamic-slice", "gather"):
                read += user.arrays[0].size / size
            elif first and user.opcode == "dynamic-update-slice" and value.name not in user.operands[1:]:
                continue
            elif first and user.opcode == "scatter" and len(user.operands) == 3:
                read += inner[user.operands[2]].arrays[0].size / size
            elif user.opcode in UNARY:
                read += self._read_share(inner, user)
            elif user.opcode == "fusion":
                nested = self.module[user.called[0]]
                places = [number for number, name in enumerate(user.operands) if name == value.name]
                read += sum(self._read_share(nested, nested.parameters[number]) for number in places)
            else:
                return 1
            if read >= 1:
                return 1
        return read

    def _written_shares(self, inner: Computation) -> list[float]:
        """Returns the share of each result that a fusion writes."""
        root = inner[inner.root]
        if root.opcode == "fusion":
            return self._written_shares(self.module[root.called[0]])
        results = [root]
        if root.opcode == "tuple":
            results = [inner[name] for name in root.operands]
        return [self._written_share(inner, result) for result in results for _ in result.arrays]

    def _written_share(self, inner: Computation, result: Instruction) -> float:
        update = _source(inner, result)
        place = {"dynamic-update-slice": 1, "scatter": 2}.get(update.opcode)
        if update.opcode == "fusion" and len(update.arrays) == 1:
            return self._written_shares(self.module[update.called[0]])[0]
        if place is None or (update.opcode == "scatter" and len(update.operands) != 3):
            return 1
        if _source(inner, inner[update.operands[0]]).opcode != "parameter":
            return 1
        return min(1.0, inner[update.operands[place]].arrays[0].size / max(1, update.arrays[0].size))

    def _products(self, inner: Computation) -> ProductCost:
        """Returns the work of all products in a fusion."""
        work = ProductCost()
        for one in inner:
            if one.opcode == "fusion":
                work += self._products(self.module[one.called[0]])
            else:
                work += self._product(one, inner)
        return work

    def _product(self, one: Instruction, computation: Computation) -> ProductCost:
        """Returns the work of a product or convolution; none for other instructions."""
        if one.opcode == "dot":
            left = computation[one.operands[0]].arrays[0]
            flops = 2 * one.arrays[0].size * prod(left.dims[axis] for axis in one.integers("lhs_contracting_dims"))
        elif one.opcode == "convolution":
            left = computation[one.operands[0]].arrays[0]
            flops = convolution_flops(one, left, computation[one.operands[1]].arrays[0], one.arrays[0])
        else:
            return ProductCost()
        return self._work(flops, left.dtype, one.attribute("operand_precision"))

    def _work(self, flops: float, dtype: str, precision: str = "") -> ProductCost:
        peak = self.card.peak
        if dtype == "f32":
            peak = self.card.float32
            if "highest" in precision:
                peak = self.card.highest
        return ProductCost(flops, flops / peak)

    def _call(self, one: Instruction, computation: Computation) -> ProductCost:
        """Returns the work of a custom call, from the shapes of its operands and results."""
        target = _target(one)
        operands = [computation[name].arrays[0] for name in one.operands]
        if target.startswith("__cublas$"):
            numbers = one.backend_config.get("gemm_backend_config", one.backend_config)["dot_dimension_numbers"]
            axes = map(int, numbers["lhs_contracting_dimensions"])
            flops = 2 * one.arrays[0].size * prod(operands[0].dims[axis] for axis in axes)
            return self._work(flops, operands[0].dtype)
        if target.startswith("__cudnn$conv"):
            arrays = [*operands[:2], one.arrays[0]]
            # Of the three arrays of a convolution (image, kernel, result), gradients compute the first or the second.
            order = {"BackwardInput": (2, 1, 0), "BackwardFilter": (0, 2, 1)}
            places = next((places for name, places in order.items() if name in target), (0, 1, 2))
            return self._work(convolution_flops(one, *(arrays[place] for place in places)), operands[0].dtype)
        if target.startswith("__cudnn$fmha"):
            scores = one.backend_config["cudnn_fmha_backend_config"]["intermediate_tensor_shape"]["dimensions"]
            products = 2 + 3 * ("Backward" in target)
            flops = products * 2 * prod(map(int, scores)) * operands[0].dims[-1]
            return self._work(flops, operands[0].dtype)
        if target in PLAIN_CALLS:
            return ProductCost()
        kernels = [name for name in KERNELS if re.search(rf"\b{re.escape(name)}\b", one.op_name)]
        if kernels:
            shapes = ([x.dims for x in operands], [x.dims for x in one.arrays])
            return self._work(kernel_flops(max(kernels, key=len), *shapes), operands[0].dtype)
        self.warnings.append(
            f"{one.name}: the operations of the custom call {target} ({one.op_name}) are not known and not counted; "
            "for a kernel of Pallas, register them in rsjax/layers/kernel_flops.py"
        )
        return ProductCost()


def _group(one: Instruction) -> list[int]:
    """Returns the devices of a collective's first group."""
    text = one.attributes.partition("replica_groups=")[2]
    if iota := re.match(r"\[([\d,]+)\]<=\[([\d,]+)\](?:T\(([\d,]+)\))?", text):
        return _iota(iota[2], iota[3]).reshape(_numbers(iota[1]))[0].tolist()
    if mesh := re.match(r"mesh\[([^\]]*)\](?:, device_ids=\(\[([\d,]+)\]T\(([\d,]+)\)\))? \{([^}]*)\}", text):
        sizes = {name: int(size) for name, size in re.findall(r"'(\w+)'=(\d+)", mesh[1])}
        devices = np.arange(prod(sizes.values()))
        if mesh[2]:
            devices = _iota(mesh[2], mesh[3])
        split = re.findall(r"'(\w+)'", mesh[4])
        axes = [axis for axis, name in enumerate(sizes) if name in split]
        grid = np.moveaxis(devices.reshape(list(sizes.values())), axes, range(-len(axes), 0))
        return grid.reshape(-1, prod(sizes[name] for name in split))[0].tolist()
    return list(one.integers("replica_groups")) or [0]


def _iota(dims: str, order: str | None) -> np.ndarray:
    """Returns the numbers from 0 on in an array of these dims, whose axes are then put in another order."""
    devices = np.arange(prod(_numbers(dims))).reshape(_numbers(dims))
    return devices.transpose(_numbers(order or "") or None).ravel()


def _numbers(text: str) -> list[int]:
    return list(map(int, re.findall(r"\d+", text)))


def convolution_flops(one: Instruction, image: Array, kernel: Array, result: Array) -> int:
    """Returns the operations of a convolution, without those on padding and on the holes of dilated images."""
    image_labels, _, rest = one.attribute("dim_labels").partition("_")
    kernel_labels, _, result_labels = rest.partition("->")
    window = {name: value.split("x") for name, value in re.findall(r"(\w+)=(\S+)", one.attribute("window"))}
    ones = ["1"] * len(window.get("size", []))
    places = 1
    for axis, size in enumerate(window.get("size", [])):
        stride = int(window.get("stride", ones)[axis])
        holes = int(window.get("lhs_dilate", ones)[axis])  # the distance of the image's elements
        step = int(window.get("rhs_dilate", ones)[axis])  # the distance of the kernel's elements
        pad = int(window.get("pad", ["0"] * len(ones))[axis].split("_")[0])
        reach = image.dims[image_labels.index(str(axis))] * holes
        starts = [out * stride - pad for out in range(result.dims[result_labels.index(str(axis))])]
        positions = [start + step * element for start in starts for element in range(int(size))]
        # The pairs of a result and a kernel's element that meet an element of the image.
        places *= sum(0 <= position < reach and position % holes == 0 for position in positions)
    outputs = result.dims[result_labels.index("b")] * result.dims[result_labels.index("f")]
    return 2 * places * outputs * kernel.dims[kernel_labels.index("i")]


def _source(inner: Computation, value: Instruction) -> Instruction:
    """Returns the instruction whose elements a value has, in another order or number format."""
    while value.opcode in UNARY:
        value = inner[value.operands[0]]
    return value


def _target(one: Instruction) -> str:
    return one.attribute("custom_call_target").strip('"')
