"""Memory that a process uses."""

from pathlib import Path

import jax

GIB = 2.0**30


def memory_scalars() -> dict[str, float]:
    """Returns memory use in GiB.

    ``device_gib`` and ``device_peak_gib`` are the use and peak use of the fullest of this process's devices; on a
    device without such counts, such as a CPU, those of the process. ``host_gib`` is the process's resident set; 0 if
    the operating system is not Linux.
    """
    host, host_peak, status = 0, 0, Path("/proc/self/status")
    if status.exists():  # psutil has no peak
        fields = dict(line.split(":", 1) for line in status.read_text().splitlines())
        host, host_peak = (int(fields[name].split()[0]) * 1024 for name in ("VmRSS", "VmHWM"))
    stats = [device.memory_stats() or {} for device in jax.local_devices()]
    now = max((s["bytes_in_use"] for s in stats if "bytes_in_use" in s), default=host)
    peak = max((s["peak_bytes_in_use"] for s in stats if "peak_bytes_in_use" in s), default=host_peak)
    return {"device_gib": now / GIB, "device_peak_gib": max(now, peak) / GIB, "host_gib": host / GIB}
