"""How much memory is free: the least of what the machine, a container and a limit leave."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from small_runs import SMALL

from skillweave import DQN, Agent, SkillweaveError
from skillweave.buffers import ram

GB = 2**30


@pytest.fixture
def system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Write files of a system of Linux."""
    monkeypatch.setattr(ram, "PROCESSES", tmp_path / "proc")
    monkeypatch.setattr(ram, "GROUPS", tmp_path / "cgroup")

    def write(files: dict[str, str]) -> None:
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)

    write({"proc/meminfo": f"MemTotal: 1 kB\nMemAvailable:  {64 * GB // 1024} kB\n"})
    return write


def group(limit: str, used: int, files: int = 0) -> dict[str, str]:
    stat = f"anon 5\ninactive_file {files}\nactive_file 7\n"
    return {"memory.max": f"{limit}\n", "memory.current": f"{used}\n", "memory.stat": stat}


def under(folder: str, files: dict[str, str]) -> dict[str, str]:
    return {f"{folder}/{name}": text for name, text in files.items()}


ROOT = {"proc/self/cgroup": "0::/\n"}
NESTED = {
    "proc/self/cgroup": "0::/slurm/job_1/step_0\n",
    **under("cgroup/slurm", group(str(9 * GB), GB)),
    **under("cgroup/slurm/job_1", group(str(5 * GB), GB)),
    **under("cgroup/slurm/job_1/step_0", group("max", GB)),
}
SYSTEMS = {
    "no groups": ({}, 64 * GB),
    "a container's group is the root": (
        ROOT | under("cgroup", group(str(4 * GB), 3 * GB, files=GB)),
        2 * GB,
    ),
    "the tightest group on the way": (NESTED, 4 * GB),
    "a group over its limit": (ROOT | under("cgroup", group(str(GB), 2 * GB)), 0),
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_what_groups_leave_is_free(system, name):
    files, free = SYSTEMS[name]
    system(files)
    assert ram.free_memory() == free


def test_the_first_version_of_groups_under_the_name_outside_of_the_container(system):
    system({"proc/self/cgroup": "5:cpu:/\n4:memory:/docker/0123\n0::/\n"})
    files = {
        "memory.limit_in_bytes": f"{3 * GB}\n",
        "memory.usage_in_bytes": f"{2 * GB}\n",
        "memory.stat": f"inactive_file 9\ntotal_inactive_file {GB // 2}\n",
    }
    system(under("cgroup/memory", files))
    assert ram.free_memory() == GB + GB // 2
    unlimited = {"memory.limit_in_bytes": "9223372036854771712\n"}
    system(under("cgroup/memory", unlimited))
    assert ram.free_memory() == 64 * GB


def test_a_replay_buffer_that_a_container_cannot_hold_is_refused(system, tmp_path):
    system(ROOT)
    system(under("cgroup", group(str(2**20), 2**19)))
    dqn = DQN(num_envs=2, buffer_size=100_000, batch_size=8, learning_starts=20, network=SMALL)
    with pytest.raises(SkillweaveError, match="GiB are free: lower buffer_size"):
        Agent("CartPole-v1", dqn, 100).train(tmp_path / "run", quiet=True)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="ulimit -v is Linux's")
def test_a_limit_of_the_shell_counts():
    code = "from skillweave.buffers.ram import free_memory; print(free_memory())"
    command = f"ulimit -v 20000000; {sys.executable} -c '{code}'"
    said = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True)
    assert 0 < int(said.stdout) < 20_000_000 * 1024
