"""The number of processors: of the affinity, and of a container's quota, from made-up files of Linux."""

import math
import os
from pathlib import Path

import pytest

import processors


def groups(directory: Path, files: dict[str, str]) -> dict[str, Path]:
    """Returns made-up files of /proc/self and /sys/fs/cgroup, the arguments of `quota`."""
    for name, text in files.items():
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        (directory / name).write_text(text)
    return {"proc": directory / "proc", "mounted": directory / "fs"}


VERSION_2 = {"proc/cgroup": "0::/kubepods/pod1/one\n"}
VERSION_1 = {"proc/cgroup": "5:memory:/m\n4:cpuset:/s\n3:cpu,cpuacct:/docker/one\n0::/\n"}
QUOTAS = [
    ({}, math.inf),
    ({"proc/cgroup": "0::/\n"}, math.inf),
    ({"proc/cgroup": "0::/\n", "fs/cpu.max": "150000 100000\n"}, 1.5),
    (VERSION_2 | {"fs/kubepods/pod1/one/cpu.max": "max 100000\n"}, math.inf),
    (VERSION_2 | {"fs/kubepods/pod1/one/cpu.max": "50000 100000\n"}, 0.5),
    # the smallest of the group's and of those above it
    (VERSION_2 | {"fs/kubepods/pod1/one/cpu.max": "max 100000", "fs/kubepods/cpu.max": "300000 100000"}, 3.0),
    (VERSION_2 | {"fs/kubepods/pod1/one/cpu.max": "800000 100000", "fs/kubepods/pod1/cpu.max": "200000 100000"}, 2.0),
    # in a container that sees only its own group, as the root
    (VERSION_2 | {"fs/cpu.max": "400000 100000\n"}, 4.0),
    ({"proc/cgroup": "0::/../one\n", "fs/cpu.max": "400000 100000\n"}, 4.0),
    (VERSION_1 | {"fs/cpu/docker/one/cpu.cfs_quota_us": "-1\n", "fs/cpu/docker/one/cpu.cfs_period_us": "100000\n"},
     math.inf),
    (VERSION_1 | {"fs/cpu/docker/one/cpu.cfs_quota_us": "250000\n", "fs/cpu/docker/one/cpu.cfs_period_us": "100000\n"},
     2.5),
    (VERSION_1 | {"fs/cpu/cpu.cfs_quota_us": "250000\n", "fs/cpu/cpu.cfs_period_us": "50000\n"}, 5.0),
    (VERSION_1 | {"fs/cpu/cpu.cfs_quota_us": "garbage\n", "fs/cpu/cpu.cfs_period_us": "50000\n"}, math.inf),
    ({"proc/cgroup": "0::/\n", "fs/cpu.max": ""}, math.inf),
    ({"proc/cgroup": "garbage\n", "fs/cpu.max": "100000 100000"}, math.inf),
]  # fmt: skip


@pytest.mark.parametrize(("files", "share"), QUOTAS)
def test_the_quota_of_a_container_is_read(files: dict[str, str], share: float, tmp_path: Path) -> None:
    assert processors.quota(**groups(tmp_path, files)) == share


@pytest.mark.parametrize(("share", "number"), [(math.inf, 3), (8.0, 3), (1.5, 2), (1.0, 1), (0.01, 1)])
def test_processors_are_those_of_the_affinity_and_of_the_quota(
    share: float, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1, 2}, raising=False)
    monkeypatch.setattr(processors, "quota", lambda: share)
    assert processors.processors() == number
