"""Small programs of XLA whose costs are counted by hand."""

from dataclasses import replace

import pytest

from rsjax.tools.compile.cards import CARDS, Card
from rsjax.tools.compile.roofline import Roofline, part_of, roofline

# One byte a second, one operation in 2 seconds (4 and 8 seconds in float32).
GPU = replace(CARDS["h100"], bandwidth=1, peak=1 / 2, float32=1 / 4, highest=1 / 8, link=1, network=1 / 2)
TPU = replace(GPU, platform="tpu")


def cost(entry: str, others: str = "", card: Card = GPU, local: int = 8) -> Roofline:
    """Returns the cost of a program whose main computation has these instructions."""
    body = "\n".join(f"  {line}" for line in entry.strip().splitlines())
    return roofline(f"HloModule test\n{others}\nENTRY %main (p: f32[]) -> f32[] {{\n{body}\n}}\n", card, local)


def test_a_product_costs_its_operations_or_its_bytes_whichever_takes_longer() -> None:
    wide = cost(
        """%a = bf16[4,8]{1,0} parameter(0)
        %b = bf16[8,2]{1,0} parameter(1)
        ROOT %c = bf16[4,2]{1,0} dot(%a, %b), lhs_contracting_dims={1}, rhs_contracting_dims={0}"""
    )
    assert (wide.flops, wide.bytes, wide.seconds, wide.launches) == (2 * 4 * 8 * 2, 2 * (32 + 16 + 8), 256, 1)
    thin = cost(
        """%a = bf16[4,1]{1,0} parameter(0)
        %b = bf16[1,4]{1,0} parameter(1)
        ROOT %c = f32[4,4]{1,0} dot(%a, %b), lhs_contracting_dims={1}, rhs_contracting_dims={0}"""
    )
    assert (thin.flops, thin.seconds) == (32, 2 * 4 + 2 * 4 + 4 * 16)


@pytest.mark.parametrize(("precision", "seconds"), [("", 512 * 4), (", operand_precision={highest,highest}", 512 * 8)])
def test_products_of_float32_have_their_own_peaks(precision: str, seconds: float) -> None:
    product = cost(
        f"""%a = f32[8,8]{{1,0}} parameter(0)
        ROOT %c = f32[8,4]{{1,0}} dot(%a, %a), lhs_contracting_dims={{1}}, rhs_contracting_dims={{0}}{precision}"""
    )
    assert product.seconds == seconds


LOOP = """
%body (x: (s32[], f32[10])) -> (s32[], f32[10]) {
  %x = (s32[], f32[10]{0}) parameter(0)
  %i = s32[] get-tuple-element(%x), index=0
  %v = f32[10]{0} get-tuple-element(%x), index=1
  %w = f32[10]{0} negate(%v)
  ROOT %t = (s32[], f32[10]{0}) tuple(%i, %w)
}
%condition (y: (s32[], f32[10])) -> pred[] {
  %y = (s32[], f32[10]{0}) parameter(0)
  %j = s32[] get-tuple-element(%y), index=0
  %limit = s32[] LIMIT
  ROOT %less = pred[] compare(%j, %limit), direction=LT
}
"""
WHILE = """%start = (s32[], f32[10]{0}) parameter(0)
ROOT %loop = (s32[], f32[10]{0}) while(%start), condition=%condition, body=%body"""


def test_a_loop_counts_as_often_as_it_runs() -> None:
    known = cost(WHILE + ', backend_config={"known_trip_count":{"n":"7"}}', LOOP.replace("LIMIT", "constant(3)"))
    assert (known.launches, known.bytes, known.seconds) == (7, 7 * 80, 7 * 80)
    assert cost(WHILE, LOOP.replace("LIMIT", "constant(3)")).launches == 3
    unknown = cost(WHILE, LOOP.replace("LIMIT", "parameter(1)"))
    assert unknown.launches == 1 and len(unknown.warnings) == 1


def test_a_fusion_reads_its_operands_and_writes_its_results_once() -> None:
    fused = """
%fused (p0: f32[100], p1: f32[100]) -> (f32[100], f32[]) {
  %p0 = f32[100]{0} parameter(0)
  %p1 = f32[100]{0} parameter(1)
  %sum = f32[100]{0} add(%p0, %p1)
  %square = f32[100]{0} multiply(%sum, %p0)
  %zero = f32[] constant(0)
  %norm = f32[] reduce(%square, %zero), dimensions={0}, to_apply=%add
  ROOT %both = (f32[100]{0}, f32[]) tuple(%square, %norm)
}
"""
    entry = """%a = f32[100]{0} parameter(0)
    %b = f32[100]{0} parameter(1)
    ROOT %f = (f32[100]{0}, f32[]) fusion(%a, %b), kind=kLoop, calls=%fused, metadata={op_name="jit(f)/mul"}"""
    assert cost(entry, fused).bytes == 400 + 400 + 400 + 4


STACK = "f32[32,100]{1,0}"
IN_ORDER = f"ROOT %f = {STACK} fusion(%a, %b, %i), kind=kLoop, calls=%fused"
BESIDE_OTHERS = f"""%s = (({STACK}, {STACK}, s32[]), {STACK}, u32[]) fusion-start(%a, %b, %i), kind=kLoop, calls=%fused
    ROOT %f = {STACK} fusion-done(%s)"""


@pytest.mark.parametrize("call", [IN_ORDER, BESIDE_OTHERS])
def test_a_fusion_reads_the_slice_and_writes_the_update_of_a_stack(call: str) -> None:
    fused = """
%fused (p0: f32[32,100], p1: f32[32,100], p2: s32[]) -> f32[32,100] {
  %p0 = f32[32,100]{1,0} parameter(0)
  %p1 = f32[32,100]{1,0} parameter(1)
  %p2 = s32[] parameter(2)
  %zero = s32[] constant(0)
  %same = f32[32,100]{1,0} convert(%p1)
  %row = f32[1,100]{1,0} dynamic-slice(%same, %p2, %zero), dynamic_slice_sizes={1,100}
  %new = f32[1,100]{1,0} negate(%row)
  ROOT %put = f32[32,100]{1,0} dynamic-update-slice(%p0, %new, %p2, %zero)
}
"""
    entry = f"""%a = {STACK} parameter(0)
    %b = {STACK} parameter(1)
    %i = s32[] parameter(2)
    {call}"""
    assert cost(entry, fused).bytes == pytest.approx(400 + 400 + 4)


@pytest.mark.parametrize(
    ("shapes", "settings", "flops"),
    [
        # A kernel of 3 × 3 on 4 × 4 pixels meets 10 of 12 positions along each axis, since padding costs nothing.
        (
            "bf16[1,4,4,8] bf16[3,3,8,5] bf16[1,4,4,5]",
            "window={size=3x3 pad=1_1x1_1}, dim_labels=b01f_01io->b01f",
            8000,
        ),
        # A product of 6 pairs of matrices, as TPUs write it.
        (
            "bf16[6,7,3] bf16[6,5,3] bf16[6,7,5]",
            "window={size=6 stride=5 lhs_dilate=6}, dim_labels=0bf_0oi->0bf",
            2 * 6 * 7 * 5 * 3,
        ),
        # A weight's gradient as a convolution: the 4 cells are the window.
        ("bf16[9,4] bf16[4,5] bf16[9,5]", "window={}, dim_labels=bf_io->bf", 2 * 9 * 4 * 5),
    ],
)
def test_a_convolution_counts_the_pixels_that_its_kernel_meets(shapes: str, settings: str, flops: int) -> None:
    image, kernel, result = shapes.split()
    made = cost(
        f"""%x = {image}{{}} parameter(0)
        %k = {kernel}{{}} parameter(1)
        ROOT %y = {result}{{}} convolution(%x, %k), {settings}"""
    )
    assert made.flops == flops


def call(target: str, operands: str, results: str, attributes: str = "", name: str = "jit(f)/call") -> Roofline:
    lines = [f"%p{i} = {shape} parameter({i})" for i, shape in enumerate(operands.split())]
    names = ", ".join(f"%p{i}" for i in range(len(lines)))
    metadata = f'metadata={{op_name="{name}"}}'
    made = f'ROOT %c = {results} custom-call({names}), custom_call_target="{target}", {metadata}, {attributes}'
    return cost("\n".join([*lines, made]))


def test_operations_inside_kernels_of_libraries_are_counted_by_formula() -> None:
    numbers = '{"lhs_contracting_dimensions":["1"],"rhs_contracting_dimensions":["0"]}'
    product = call(
        "__cublas$gemm",
        "bf16[4,8]{1,0} bf16[8,2]{1,0}",
        "(bf16[4,2]{1,0}, s8[1000]{0})",
        f'backend_config={{"gemm_backend_config":{{"dot_dimension_numbers":{numbers}}}}}',
    )
    assert product.flops == 128 and product.bytes == 2 * (32 + 16 + 8)  # without the workspace
    scores = (
        'backend_config={"cudnn_fmha_backend_config":{"intermediate_tensor_shape":{"dimensions":["2","4","6","6"]}}}'
    )
    heads = "bf16[2,6,4,8]{3,2,1,0}"
    forward = call("__cudnn$fmhaSoftmax", f"{heads} {heads} {heads}", f"({heads}, u8[0]{{0}})", scores)
    assert forward.flops == 2 * 2 * (2 * 4 * 6 * 6) * 8
    backward = call("__cudnn$fmhaSoftmaxBackward", f"{heads} {heads} {heads}", f"({heads})", scores)
    assert backward.flops == 5 * 2 * (2 * 4 * 6 * 6) * 8


def test_a_kernel_counts_what_its_author_registered_and_an_unknown_one_is_reported() -> None:
    qkv = "bf16[2,6,16,3,4,8]{5,4,3,2,1,0}"
    heads = "bf16[2,6,16,4,8]{4,3,2,1,0}"
    results = f"({heads}, f32[2,6,4,16]{{3,2,1,0}})"
    known = call("__gpu$xla.gpu.triton", qkv, results, name="jit(f)/attend_cells_forward/pallas_call")
    assert known.flops == 2 * 2 * (2 * 6 * 4) * 16**2 * 8 and not known.warnings
    unknown = call("__gpu$xla.gpu.triton", heads, heads, name="jit(f)/mystery/pallas_call")
    assert unknown.flops == 0 and "mystery" in unknown.warnings[0]


def test_arrays_on_a_tpus_chip_cost_nothing_and_those_in_memory_their_padding() -> None:
    entry = """%a = bf16[3,100]{1,0:T(8,128)(2,1)} parameter(0)
    %b = bf16[3,100]{1,0:T(8,128)(2,1)S(1)} negate(%a)
    %c = (bf16[3,100]{1,0:T(8,128)(2,1)}, bf16[3,100]{1,0:T(8,128)(2,1)S(1)}, u32[]{:S(2)}) copy-start(%b)
    ROOT %d = bf16[3,100]{1,0:T(8,128)(2,1)} copy-done(%c)"""
    moved = cost(entry, card=TPU)
    assert [kernel.bytes for kernel in moved.kernels] == [2 * 8 * 128, 2 * 8 * 128]


def test_a_computation_of_another_thread_ends_like_any() -> None:
    gather = """
%gather (x: f32[10]) -> f32[10] {
  %x = f32[10]{0} parameter(0)
  ROOT %y = f32[10]{0} custom-call(%x), custom_call_target="TODO(b/522284627)"
}, execution_thread="sparsecore"

%other (x: f32[10]) -> f32[10] {
  ROOT %x = f32[10]{0} parameter(0)
}
"""
    entry = """%v = f32[10]{0} parameter(0)
    %start = ((f32[10]{0}), f32[10]{0}, u32[]) async-start(%v), async_execution_thread="sparsecore", calls=%gather
    ROOT %done = f32[10]{0} async-done(%start)"""
    moved = cost(entry, gather, card=TPU)
    assert moved.bytes == 80 and not moved.warnings


def test_a_condition_costs_its_longer_branch() -> None:
    branches = """
%short (x: f32[10]) -> f32[10] {
  %x = f32[10]{0} parameter(0)
  ROOT %n = f32[10]{0} negate(%x)
}
%long (y: f32[10]) -> f32[10] {
  %y = f32[10]{0} parameter(0)
  %m = f32[10]{0} negate(%y)
  ROOT %o = f32[10]{0} exponential(%m)
}
"""
    entry = """%i = s32[] parameter(0)
    %v = f32[10]{0} parameter(1)
    ROOT %c = f32[10]{0} conditional(%i, %v, %v), branch_computations={%short, %long}"""
    assert cost(entry, branches).launches == 2


def collective(groups: str, card: Card = GPU, between: str = "") -> Roofline:
    """Returns the cost of adding 100 numbers over devices; 4 are on each host."""
    entry = f"""%g = f32[100]{{0}} parameter(0)
    %s = f32[100]{{0}} all-reduce-start(%g), replica_groups={groups}, to_apply=%add
    {between}
    ROOT %d = f32[100]{{0}} all-reduce-done(%s)"""
    return cost(entry, card=card, local=4)


# Devices that add their numbers exchange 2 · (1 - 1/devices) of them.
@pytest.mark.parametrize(
    ("groups", "sent"),
    [
        ("{{0,1,2,3},{4,5,6,7}}", 2 * 400 * 3 / 4),
        ("[2,4]<=[8], use_global_device_ids=true", 2 * 400 * 3 / 4),
        ("mesh['a'=2,'b'=4] {'b'}, use_global_device_ids=true", 2 * 400 * 3 / 4),
        ("mesh['a'=4,'b'=2], device_ids=([2,4]T(1,0)) {'b'}", 2 * 400 * 1 / 2),
    ],
)
def test_a_collective_sends_its_share(groups: str, sent: float) -> None:
    assert collective(groups).collectives() == {"all-reduce": (1, sent)}


@pytest.mark.parametrize(
    ("groups", "seconds"),
    [
        ("[2,4]<=[8]", 600 * 100),  # each group on one host: over the links
        ("[4,2]<=[2,4]T(1,0)", 400 * 1000),  # one card on each of two hosts: over its adapter
        ("[1,8]<=[8]", 400 * 1000 / 4),  # all cards: the four adapters of a host carry its share
    ],
)
def test_between_hosts_a_collective_goes_over_the_network(groups: str, seconds: float) -> None:
    slow = replace(GPU, link=1 / 100, network=1 / 1000)
    in_memory = 800
    assert collective(groups, slow).exposed == pytest.approx(seconds - in_memory)


def test_kernels_that_run_beside_a_collective_hide_it() -> None:
    slow = replace(GPU, link=1 / 100)
    in_memory = 800
    beside = "%n = f32[100]{0} negate(%g)"
    alone = collective("{{0,1,2,3}}", slow)
    hidden = collective("{{0,1,2,3}}", slow, beside)
    assert alone.exposed == pytest.approx(600 * 100 - in_memory)
    assert hidden.exposed == pytest.approx(alone.exposed - 800)


@pytest.mark.parametrize(
    ("op_name", "part"),
    [
        (
            "jit(train_step)/jvp(Transformer)/while/body/closed_call/blocks/rgb/fc1/dot_general",
            "forward blocks/rgb/fc1",
        ),
        (
            "jit(train_step)/transpose(jvp(Transformer))/while/body/closed_call/checkpoint/rematted_computation/blocks/rgb/"
            "spatial_attn.spatial/vmap(BTNH,BSNH->BNTS)/dot_general",
            "recomputed blocks/rgb/spatial_attn",
        ),
        ("jit(train_step)/transpose(jvp())/mul", "backward loss and masks"),
        ("jit(train_step)/sqrt", "optimizer"),
        ("jit(train_step)/jvp(Transformer)/while/body/dynamic_slice", "forward the loop over blocks"),
        ("", "other"),
    ],
)
def test_an_operation_names_its_part_of_the_model(op_name: str, part: str) -> None:
    assert part_of(op_name) == part
