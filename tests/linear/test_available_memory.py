"""Claims about the free memory: what caches hold is free, and the lowest limit counts."""

import pytest

import jaxcontact as jc
from jaxcontact.linear import check_memory, choice
from jaxcontact.linear.memory import host_memory

MEMINFO = "MemTotal:  8000 kB\nMemFree:  100 kB\nMemAvailable:  5000 kB\n"
AVAILABLE = 5000 * 1024
JOB = "sys/fs/cgroup/jobs/7"
JOB_V1 = "sys/fs/cgroup/memory/jobs/7"


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        pytest.param({}, AVAILABLE, id="no control group"),
        pytest.param(
            {
                "proc/self/cgroup": "0::/jobs/7\n",
                f"{JOB}/memory.max": "1000000\n",
                f"{JOB}/memory.current": "700000\n",
                f"{JOB}/memory.stat": "anon 600000\ninactive_file 50000\n",
            },
            350_000,
            id="v2, cached files are free",
        ),
        pytest.param(
            {
                "proc/self/cgroup": "0::/jobs/7\n",
                f"{JOB}/memory.max": "max\n",
                f"{JOB}/memory.current": "700000\n",
                "sys/fs/cgroup/jobs/memory.max": "900000\n",
                "sys/fs/cgroup/jobs/memory.current": "800000\n",
            },
            100_000,
            id="v2, limit of the group above",
        ),
        pytest.param(
            {
                "proc/self/cgroup": "0::/on/the/host\n",
                "sys/fs/cgroup/memory.max": "1000\n",
                "sys/fs/cgroup/memory.current": "1200\n",
            },
            0,
            id="v2, container, nothing left",
        ),
        pytest.param(
            {
                "proc/self/cgroup": "9:cpu,cpuacct:/\n4:memory:/jobs/7\n0::/\n",
                f"{JOB_V1}/memory.limit_in_bytes": "1000000\n",
                f"{JOB_V1}/memory.usage_in_bytes": "400000\n",
                f"{JOB_V1}/memory.stat": "inactive_file 1\ntotal_inactive_file 10000\n",
            },
            610_000,
            id="v1",
        ),
        pytest.param(
            {
                "proc/self/cgroup": "4:memory:/\n",
                "sys/fs/cgroup/memory/memory.limit_in_bytes": f"{2**63 - 4096}\n",
                "sys/fs/cgroup/memory/memory.usage_in_bytes": "400000\n",
            },
            AVAILABLE,
            id="v1, no limit",
        ),
    ],
)
def test_host_memory_is_the_lowest_limit(tmp_path, files, expected):
    for name, text in {"proc/meminfo": MEMINFO, **files}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert host_memory(tmp_path) == expected


def test_host_memory_without_linux_counts_free_pages(tmp_path, monkeypatch):
    sizes = {"SC_AVPHYS_PAGES": 12, "SC_PAGE_SIZE": 4096}
    monkeypatch.setattr("os.sysconf", sizes.__getitem__)
    assert host_memory(tmp_path) == 12 * 4096


def test_host_memory_is_none_where_nothing_tells(tmp_path, monkeypatch):
    monkeypatch.delattr("os.sysconf")
    assert host_memory(tmp_path) is None


@pytest.mark.parametrize(
    ("solver", "size", "fits"),
    [
        (jc.Dense(), 6000, True),
        (jc.Dense(), 7000, False),
        (jc.NestedDissection(), 700_000, True),
        (jc.NestedDissection(), 800_000, False),
        (jc.ConjugateGradient(), 1_000_000, True),
    ],
)
def test_check_memory_refuses_what_does_not_fit(monkeypatch, solver, size, fits):
    monkeypatch.setattr(choice, "available_memory", lambda: 2**30)
    if fits:
        check_memory(solver, size, 2, 8)
        return
    with pytest.raises(ValueError, match=rf"{type(solver).__name__} for {size} unknowns"):
        check_memory(solver, size, 2, 8)
