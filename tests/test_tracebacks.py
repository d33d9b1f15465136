"""The user's file and line in messages; tracebacks in IPython show only the user's code."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import pytest

from skillweave.messages import told
from skillweave.tracebacks import place

HERE = Path(__file__).name


def caught(function: Callable[[], Any]) -> Exception:
    with pytest.raises(Exception) as error:  # noqa: PT011
        function()
    return error.value


def line_of(text: str) -> int:
    lines = Path(__file__).read_text().splitlines()
    return next(i for i, line in enumerate(lines, 1) if text in line and "line_of" not in line)


def test_the_line_is_the_users_and_not_that_of_numpy_or_of_the_standard_library() -> None:
    def of_numpy() -> None:
        np.stack([])  # a function of NumPy's fails

    def of_json() -> None:
        json.loads("{")  # a function of Python's own fails

    assert place(caught(of_numpy)) == f"{HERE}, line {line_of('of NumPy')}"
    assert place(caught(of_json)) == f"{HERE}, line {line_of('own fails')}"
    assert told(caught(of_json)).startswith("JSONDecodeError: Expecting")


def test_without_a_frame_there_is_no_place() -> None:
    assert place(ValueError()) == ""
    assert told(ValueError("x")) == "ValueError: x"


def test_code_that_was_sent_to_another_process_is_named_by_its_file_or_its_function() -> None:
    code = "def reward():\n    return 1 / 0\n"
    script: dict[str, Any] = {"__file__": "/somewhere/lander.py"}
    notebook: dict[str, Any] = {}
    for names in (script, notebook):
        names["__name__"] = "__main__"
        exec(compile(code, "whatever.py", "exec"), names)
    sent = [cloudpickle.loads(cloudpickle.dumps(names["reward"])) for names in (script, notebook)]
    assert place(caught(sent[0])) == "lander.py, line 2"
    assert place(caught(sent[1])) == "reward(), line 2"


CELLS = '''
from IPython.core.interactiveshell import InteractiveShell
shell = InteractiveShell.instance(colors="NoColor")
shell.run_cell("""import skillweave as sw

class Center(sw.Skill):
    def reward(self, step):
        return step.next_obs[:, 9]
""", store_history=True)
shell.run_cell("""tiny = sw.PPO(num_envs=2, n_steps=8, batch_size=16)
agent = sw.Hierarchy("CartPole-v1", [Center()], algorithm=tiny)
agent.train("run", quiet=True)
""", store_history=True)
shell.run_cell("""from skillweave.runs.directory import RunDirectory
def interrupt(*_): raise KeyboardInterrupt
RunDirectory.log = interrupt
sw.Agent("CartPole-v1", tiny, 100).train("stopped", quiet=True)
""", store_history=True)
'''


def in_ipython(folder: Path, **environment: str) -> str:
    pytest.importorskip("IPython")
    (folder / "cells.py").write_text(CELLS)
    known = os.environ | {"IPYTHONDIR": str(folder), "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "cells.py"]
    done = subprocess.run(
        command,
        cwd=folder,
        env=known | environment,
        check=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    return done.stdout


def test_ipython_shows_the_users_lines_and_one_sentence(tmp_path: Path) -> None:
    shown = in_ipython(tmp_path)
    assert "In[2], line 3" in shown
    assert 'agent.train("run", quiet=True)' in shown
    assert "In[1], line 5" in shown
    assert "return step.next_obs[:, 9]" in shown
    shown, _, interrupted = shown.partition("-" * 70)[2].partition("-" * 70)
    *_, last = shown.strip().splitlines()
    assert last.startswith("SkillweaveError: skill 'center': reward() raised IndexError: index")
    assert last.endswith("(Cell In[1], line 5) at step 1")
    assert "skillweave/" not in shown
    assert "direct cause" not in shown
    assert len(shown.splitlines()) < 25
    assert "In[3], line 4" in interrupted
    assert "Interrupted: saved at the start; go on with: resume('stopped')" in interrupted
    assert "skillweave/" not in interrupted


def test_ipython_shows_all_frames_where_the_switch_is_set(tmp_path: Path) -> None:
    shown = in_ipython(tmp_path, SKILLWEAVE_TRACEBACK="1")
    assert "skillweave/skills/outputs.py" in shown
    assert "IndexError" in shown
