"""Figures of the accelerators that programs are compiled for, from their makers' data sheets."""

from dataclasses import dataclass

NVIDIA = "https://resources.nvidia.com"
GOOGLE = "https://docs.cloud.google.com/tpu/docs"
XLA = "https://github.com/openxla/xla/tree/main/xla/backends/gpu/target_config/specs"

# XLA's GpuTargetConfigProto; 9.10 is the cuDNN for which it chooses kernels.
_GPU = """gpu_device_info {{
  threads_per_block_limit: 1024 threads_per_warp: 32 shared_memory_per_block: 49152
  block_dim_limit_x: 2147483647 block_dim_limit_y: 65535 block_dim_limit_z: 65535
  registers_per_core_limit: 65536 registers_per_block_limit: 65536
  cuda_compute_capability {{ major: {0} minor: {1} }}
  core_count: {2} threads_per_core_limit: {3} fpus_per_core: {4} clock_rate_ghz: {5}
  shared_memory_per_core: {6} shared_memory_per_block_optin: {7} l2_cache_size: {8}
  memory_bandwidth: {9} device_memory_size: {10}
}}
platform_name: "CUDA" dnn_version_info {{ major: 9 minor: 10 }} device_description_str: "{11}" """


@dataclass(frozen=True)
class Card:
    """One accelerator, a chip of a TPU.

    Attributes:
        title: its name.
        platform: cuda or tpu.
        peak: operations a second of dense bf16 products with float32 accumulation.
        float32: the same of float32 arrays in the default precision: TF32 on a GPU, one pass of bf16 on a TPU.
        highest: the same in the highest precision.
        bandwidth: bytes a second of its memory.
        memory: bytes that programs may use.
        link: bytes a second to other cards of its host, or of the TPU's slice, in one direction.
        network: bytes a second to other hosts; the same as ``link`` in a slice of TPUs.
        source: where the figures come from.
        description: of a GPU, for XLA; XLA knows TPUs.
    """

    title: str
    platform: str
    peak: float
    float32: float
    highest: float
    bandwidth: float
    memory: float
    link: float
    network: float
    source: str
    description: str = ""


GIB = 2**30

# Peaks of GPUs are a half of the rates with sparsity where data sheets give those. The network of GPUs is one adapter
# for each card, as in the makers' own hosts: 400 Gbit/s (H100), 200 Gbit/s (A100), 25 Gbit/s (RTX 4090, a guess).
CARDS = {
    "h100": Card(
        title="NVIDIA H100 SXM 80 GB",
        platform="cuda",
        peak=989e12,
        float32=494e12,
        highest=67e12,
        bandwidth=3.35e12,
        memory=84_978_434_048,
        link=450e9,
        network=50e9,
        source=f"{NVIDIA}/en-us-gpu-resources/h100-datasheet-24306; {XLA}/h100_sxm.txtpb",
        description=_GPU.format(
            9, 0, 132, 2048, 128, 1.98, 233472, 232448, 52428800, 3352320000000, 84978434048, "NVIDIA H100 80GB HBM3"
        ),
    ),
    "a100": Card(
        title="NVIDIA A100 SXM 80 GB",
        platform="cuda",
        peak=312e12,
        float32=156e12,
        highest=19.5e12,
        bandwidth=2.04e12,
        memory=85_100_068_864,
        link=300e9,
        network=25e9,
        source=f"{NVIDIA}/en-us-genomics-ep/ampere-architecture-white-paper; {XLA}/a100_sxm_80.txtpb",
        description=_GPU.format(
            8, 0, 108, 2048, 64, 1.41, 167936, 166912, 41943040, 2039040000000, 85100068864, "NVIDIA A100-SXM4-80GB"
        ),
    ),
    "rtx4090": Card(
        title="NVIDIA GeForce RTX 4090",
        platform="cuda",
        peak=165e12,
        float32=82.6e12,
        highest=82.6e12,
        bandwidth=1.01e12,
        memory=25_386_352_640,
        link=32e9,
        network=3.1e9,
        source="https://images.nvidia.com/aem-dam/Solutions/geforce/ada/nvidia-ada-gpu-architecture.pdf, appendix A",
        description=_GPU.format(
            8, 9, 128, 1536, 128, 2.52, 102400, 101376, 75497472, 1008096000000, 25386352640, "NVIDIA GeForce RTX 4090"
        ),
    ),
    "v4": Card(
        title="TPU v4",
        platform="tpu",
        peak=275e12,
        float32=275e12,
        highest=275e12 / 6,
        bandwidth=1.2e12,
        memory=31.75 * GIB,
        link=300e9,
        network=300e9,
        source=f"{GOOGLE}/v4",
    ),
    "v5e": Card(
        title="TPU v5e",
        platform="tpu",
        peak=197e12,
        float32=197e12,
        highest=197e12 / 6,
        bandwidth=0.82e12,
        memory=15.75 * GIB,
        link=200e9,
        network=200e9,
        source=f"{GOOGLE}/v5e",
    ),
    "v5p": Card(
        title="TPU v5p",
        platform="tpu",
        peak=459e12,
        float32=459e12,
        highest=459e12 / 6,
        bandwidth=2.77e12,
        memory=95.74 * GIB,
        link=600e9,
        network=600e9,
        source=f"{GOOGLE}/v5p",
    ),
    "v6e": Card(
        title="TPU v6e",
        platform="tpu",
        peak=918e12,
        float32=918e12,
        highest=918e12 / 6,
        bandwidth=1.64e12,
        memory=31.25 * GIB,
        link=400e9,
        network=400e9,
        source=f"{GOOGLE}/v6e",
    ),
}
