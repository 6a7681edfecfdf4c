"""How much memory is free, as far as the machine tells.

Memory that caches hold counts as free, and the limit of a control group (a container, a batch job)
counts where it is lower than what the machine has.
Source: the Linux kernel documentation (2024) of /proc/meminfo, cgroup v1 `memory` and cgroup v2.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import jax


def available_memory() -> int | None:
    """Return the free memory of the default device, [bytes]; None if it is not known."""
    stats = jax.devices()[0].memory_stats()
    if stats and "bytes_limit" in stats:
        return stats["bytes_limit"] - stats.get("bytes_in_use", 0)
    return host_memory()


def host_memory(root: Path = Path("/")) -> int | None:
    """Return the memory that this process can still get, [bytes]; None if it is not known.

    Args:
        root: where the file systems `proc` and `sys` are found.
    """
    machine = _machine_memory(root / "proc/meminfo")
    known = [*([] if machine is None else [machine]), *_left_in_control_groups(root)]
    return min(known, default=None)


def _machine_memory(meminfo: Path) -> int | None:
    for line in _read(meminfo).splitlines():
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def _left_in_control_groups(root: Path) -> Iterator[int]:
    """Yield what each limit on the process leaves, [bytes]: its groups and all groups above."""
    for line in _read(root / "proc/self/cgroup").splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            top, limit, usage, cache = "", "memory.max", "memory.current", "inactive_file"
        elif "memory" in controllers.split(","):
            top, limit = "memory", "memory.limit_in_bytes"
            usage, cache = "memory.usage_in_bytes", "total_inactive_file"
        else:
            continue
        # In a container the path may be that of the host, which is not there: the top counts.
        group = Path(path.lstrip("/"))
        for folder in (group, *group.parents):
            files = root / "sys/fs/cgroup" / top / folder
            most, used = _read(files / limit).strip(), _read(files / usage).strip()
            if most.isdigit() and used.isdigit():  # no limit reads "max"
                yield max(int(most) - int(used) + _cached(files / "memory.stat", cache), 0)


def _cached(stat: Path, key: str) -> int:
    """Return the bytes of cached files that the kernel gives back first."""
    entries = dict(line.split()[:2] for line in _read(stat).splitlines())
    return int(entries.get(key, 0))


def _read(path: Path) -> str:
    """Return the text of a file, empty if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""
