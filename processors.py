"""The number of processors that this process may use."""

import math
import os
from pathlib import Path


def processors() -> int:
    """Returns how many processors this process may use, by its affinity and a container's quota."""
    own = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, math.ceil(min(own, quota())))


def quota(proc: Path = Path("/proc/self"), mounted: Path = Path("/sys/fs/cgroup")) -> float:
    """Returns the seconds of processor time per second from Linux' control groups for this process; infinity: no limit.

    `docker --cpus` and Kubernetes set it. The smallest quota of the process's group and of its parent groups counts.

    Args:
        proc: has `cgroup`, the process's groups; mounted: where the groups' files are.
    """
    try:
        lines = (proc / "cgroup").read_text(encoding="utf-8").splitlines()
        groups = [(controllers, path) for _, controllers, path in (line.split(":", 2) for line in lines)]
    except (OSError, ValueError):
        return math.inf
    shares = [math.inf]
    for controllers, path in groups:
        if controllers and "cpu" not in controllers.split(","):
            continue
        root = mounted / "cpu" if controllers else mounted  # of version 1, or 2
        group = root / path.lstrip("/")
        # in a container the path may be the host's, and then only its root exists here
        shares += [share_of(each) for each in (group, *group.parents) if each.is_relative_to(root)]
    return min(shares)


def share_of(group: Path) -> float:
    """Returns the seconds per second that a control group of version 1 or 2 gives; infinity if it has no quota."""
    try:
        if (file := group / "cpu.max").exists():
            given, period = file.read_text(encoding="utf-8").split()
        else:
            given, period = (
                (group / f"cpu.cfs_{name}_us").read_text("utf-8") for name in ("quota", "period")
            )
        return int(given) / int(period) if int(given) > 0 and int(period) > 0 else math.inf
    except (OSError, ValueError):  # "max" is no number
        return math.inf
