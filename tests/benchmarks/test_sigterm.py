"""A benchmark that is sent SIGTERM leaves no process behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from living import alive, all_end

ROOT = Path(__file__).parents[2]
STUB = """
import os, sys, time
from pathlib import Path
from benchmarks.common import run_command, workers

def work(path):
    Path(path).with_suffix(".new").write_text(str(os.getpid()))
    Path(path).with_suffix(".new").rename(path)
    time.sleep(600)

if __name__ == "__main__":
    how, path = sys.argv[1:]
    if how == "worker":
        with workers(1) as pool:
            pool.submit(work, path).result()
    elif how == "command":
        run_command([sys.executable, "-c", f"import stub; stub.work({path!r})"])
    else:
        run_command([sys.executable, "stub.py", how.removeprefix("command, then "), path])
"""


def until(condition):
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.01)
    return False


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="there is no /proc here")
@pytest.mark.parametrize("how", ["worker", "command", "command, then worker"])
def test_a_benchmark_that_is_sent_sigterm_leaves_no_process(tmp_path, how):
    (tmp_path / "stub.py").write_text(STUB)
    told = tmp_path / "pid"
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "stub.py", how, str(told)]
    with subprocess.Popen(command, cwd=tmp_path, env=env) as stub:
        try:
            assert until(told.exists)
            pid = int(told.read_text())
            assert alive(pid)
            stub.terminate()
            assert until(lambda: stub.poll() is not None)
        finally:
            stub.kill()
    assert all_end([pid], 20.0)
    assert stub.returncode in (-signal.SIGTERM, 128 + signal.SIGTERM)


@pytest.mark.slow
def test_a_command_that_fails_is_told(tmp_path):
    from benchmarks.common import run_command

    command = [sys.executable, "-c", "print(7); raise SystemExit(3)"]
    before = signal.getsignal(signal.SIGTERM)
    try:
        done = run_command(command, capture=True, check=False)
        assert (done.returncode, done.stdout) == (3, "7\n")
        with pytest.raises(subprocess.CalledProcessError):
            run_command(command, capture=True)
    finally:
        signal.signal(signal.SIGTERM, before)
