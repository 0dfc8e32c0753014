"""Where and with what a number was measured."""

import os
import platform
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

from wm_nodes.core.device import CPU, compute_device, device_label

PACKAGES = ("wm_nodes", "torch", "numpy", "mani_skill", "sapien", "rclpy", "rosbags")


def machine_facts(device: str = CPU) -> dict[str, str]:
    """Date, processor, usable cores, memory, system, Python and package versions, by name. No host or user name.

    device: the setting that the numbers were made with; a GPU is among the facts.
    """
    kilobytes = _field("/proc/meminfo", "MemTotal").split()[:1]
    facts = {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "processor": _field("/proc/cpuinfo", "model name") or platform.processor() or platform.machine(),
        "cores": str(len(os.sched_getaffinity(0))),
        "memory": f"{int(kilobytes[0]) / 2**20:.1f} GiB" if kilobytes else "unknown",
        "system": f"{_field('/etc/os-release', 'PRETTY_NAME', '=').strip(chr(34))} {platform.machine()}".strip(),
        "python": platform.python_version(),
        "device": device_label(compute_device(device)),
    }
    for name in PACKAGES:
        try:
            facts[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return facts


def _field(path: str, name: str, separator: str = ":") -> str:
    """The first `name: value` of a text file, "" where there is none."""
    try:
        lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    values = (line.split(separator, 1)[1].strip() for line in lines if line.split(separator)[0].strip() == name)
    return next(values, "")
