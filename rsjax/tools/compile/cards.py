"""Figures of the accelerators that programs are compiled for, from their makers' data sheets."""

from dataclasses import dataclass

# XLA's GpuTargetConfigProto without the card's own fields.
_GPU = """gpu_device_info {{
  threads_per_block_limit: 1024 threads_per_warp: 32 shared_memory_per_block: 49152
  block_dim_limit_x: 2147483647 block_dim_limit_y: 65535 block_dim_limit_z: 65535
  registers_per_core_limit: 65536 registers_per_block_limit: 65536 {0}
}}
platform_name: "CUDA" dnn_version_info {{ major: 9 minor: 10 }} device_description_str: "{1}" """


@dataclass(frozen=True)
class Card:
    """One accelerator.

    Attributes:
        title: its name.
        platform: cuda or tpu.
        peak: operations a second of dense bf16 products with float32 accumulation.
        tf32: the same of float32 arrays in the default precision.
        float32: the same of float32 arrays in the highest precision.
        bandwidth: of its memory, bytes a second.
        memory: bytes.
        gpu: XLA's description of the card; "" for a TPU, which XLA knows.
    """

    title: str
    platform: str
    peak: float
    tf32: float
    float32: float
    bandwidth: float
    memory: float
    gpu: str = ""


CARDS = {
    # https://resources.nvidia.com/en-us-tensor-core/nvidia-tensor-core-gpu-datasheet: H100 SXM, half of its rates with
    # sparsity
    "h100": Card(
        "NVIDIA H100 SXM 80 GB", "cuda", 989e12, 494e12, 67e12, 3.35e12, 84_978_434_048,
        _GPU.format(
            "shared_memory_per_core: 233472 threads_per_core_limit: 2048 core_count: 132 fpus_per_core: 128 "
            "memory_bandwidth: 3352320000000 l2_cache_size: 52428800 clock_rate_ghz: 1.98 "
            "device_memory_size: 84978434048 shared_memory_per_block_optin: 232448 "
            "cuda_compute_capability { major: 9 }",
            "NVIDIA H100 80GB HBM3",
        ),
    ),
}  # fmt: skip
