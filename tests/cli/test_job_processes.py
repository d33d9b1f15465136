"""Jobs in processes of their own: what they return or raise, and how they end."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from living import all_end

from skillweave.cli.jobs import ProcessEnded, Processes
from skillweave.errors import SkillweaveError


def doubled(x: int) -> int:
    return 2 * x


def refused() -> None:
    raise SkillweaveError("too small")


def failed() -> None:
    raise KeyError("not here")


def unsendable() -> threading.Lock:
    return threading.Lock()


def ended_beside_a_child() -> None:
    """Is killed while a process that it has begun still holds its pipe."""
    multiprocessing.get_context("fork").Process(target=time.sleep, args=(30,)).start()
    os.kill(os.getpid(), signal.SIGKILL)


def test_jobs_return_or_raise_what_they_did_there():
    with Processes(2) as pool:
        results = [pool.submit(doubled, i) for i in range(3)]
        wrong = {job: pool.submit(job) for job in (refused, failed, unsendable)}
        assert [r.result() for r in results] == [0, 2, 4]
        with pytest.raises(SkillweaveError, match="too small"):
            wrong[refused].result()
        with pytest.raises(RuntimeError, match="KeyError: 'not here'"):
            wrong[failed].result()
        with pytest.raises(RuntimeError, match="lock"):
            wrong[unsendable].result()


def test_a_process_that_is_ended_is_told_at_once_though_another_holds_its_pipe():
    started = time.monotonic()
    with Processes(1) as pool, pytest.raises(ProcessEnded, match="exit code -9"):
        pool.submit(ended_beside_a_child).result()
    assert time.monotonic() - started < 25  # its child sleeps for 30 s


def test_an_error_here_ends_all_jobs_and_begins_no_other():
    started, due = time.monotonic(), []

    def failing() -> None:
        with Processes(1) as pool:
            due.extend(pool.submit(time.sleep, 60) for _ in range(2))
            raise ValueError("enough")

    with pytest.raises(ValueError, match="enough"):
        failing()
    for future in due:
        with pytest.raises(ProcessEnded):
            future.result()
    assert time.monotonic() - started < 50


PARENT = """
import os, signal, sys, time
from test_job_processes import announced
from skillweave.cli.jobs import Processes
if __name__ == "__main__":
    with Processes(1) as pool:
        pool.submit(announced, sys.argv[1])
        while not os.path.exists(sys.argv[1]):
            time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGKILL)
"""


def announced(file: str) -> None:
    """Write its process's id, and stay."""
    Path(file).write_text(str(os.getpid()))
    time.sleep(300)


def test_a_job_ends_soon_after_its_parent_was_killed(tmp_path):
    (tmp_path / "parent.py").write_text(PARENT)
    paths = {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, str(tmp_path / "parent.py"), str(tmp_path / "pid")]
    assert subprocess.run(command, env=os.environ | paths).returncode == -signal.SIGKILL
    assert all_end([int((tmp_path / "pid").read_text())])
