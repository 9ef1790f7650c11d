"""How much memory a process takes."""

import os
from pathlib import Path

import jax

GIB = 2.0**30


def memory_scalars() -> dict[str, float]:
    """Memory now, in GiB.

    Returns:
        ``device_gib`` and ``device_peak_gib``: what the fullest of this process's devices holds, and has held at the
        most; on a device that does not tell, such as a CPU, what the process holds. ``host_gib``: the process's
        resident set; 0 where the operating system is not Linux.
    """
    host, host_peak = _resident_set()
    stats = [device.memory_stats() or {} for device in jax.local_devices()]
    now = max((s["bytes_in_use"] for s in stats if "bytes_in_use" in s), default=host)
    peak = max((s["peak_bytes_in_use"] for s in stats if "peak_bytes_in_use" in s), default=host_peak)
    return {"device_gib": now / GIB, "device_peak_gib": max(now, peak) / GIB, "host_gib": host / GIB}


def _resident_set() -> tuple[int, int]:
    """Bytes of this process that are in memory, now and at the most."""
    path = Path(f"/proc/{os.getpid()}/status")
    if not path.exists():
        return 0, 0
    fields = dict(line.partition(":")[::2] for line in path.read_text().splitlines())
    now, peak = (int(fields[name].split()[0]) * 1024 for name in ("VmRSS", "VmHWM"))
    return now, peak
