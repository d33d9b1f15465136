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
import gymnasium as gym
import numpy as np
import pytest
from toys import World

from skillweave import PPO, EnvSpec, Hierarchy, Skill, evaluate
from skillweave._internal.messages import error_text
from skillweave._internal.tracebacks import LIBRARY, place
from skillweave.errors import EnvError, PolicyError, SkillError
from skillweave.skills.outputs import blame
from skillweave.types import Memoryless

HERE = Path(__file__).name


def caught(function: Callable[[], Any]) -> Exception:
    with pytest.raises(Exception) as error:  # noqa: PT011
        function()
    return error.value


def line_of(text: str) -> int:
    lines = Path(__file__).read_text().splitlines()
    return next(i for i, line in enumerate(lines, 1) if line.endswith(text))


def test_the_line_is_the_users_and_not_that_of_numpy_or_of_the_standard_library():
    def of_numpy() -> None:
        np.stack([])  # a function of NumPy fails

    def of_json() -> None:
        json.loads("{")  # a function of Python fails

    assert place(caught(of_numpy)) == f"{HERE}, line {line_of('function of NumPy fails')}"
    assert place(caught(of_json)) == f"{HERE}, line {line_of('function of Python fails')}"
    assert error_text(caught(of_json)).startswith("JSONDecodeError: Expecting")
    assert (place(ValueError()), error_text(ValueError("x"))) == ("", "ValueError: x")


def test_code_that_was_sent_to_another_process_is_named_by_its_file_or_its_function():
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
    # Not this process's path: other tests leave folders on it.
    known = os.environ | {"IPYTHONDIR": str(folder), "PYTHONPATH": str(LIBRARY.parent)}
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


@pytest.mark.slow
def test_ipython_shows_the_users_lines_and_one_sentence(tmp_path):
    shown = in_ipython(tmp_path)
    assert "In[2], line 3" in shown
    assert 'agent.train("run", quiet=True)' in shown
    assert "In[1], line 5" in shown
    assert "return step.next_obs[:, 9]" in shown
    shown, _, interrupted = shown.partition("-" * 70)[2].partition("-" * 70)
    *_, last = shown.strip().splitlines()
    assert last.startswith("SkillError: skill 'center': reward() raised IndexError: index")
    assert last.endswith("(Cell In[1], line 5) at step 1; step.next_obs has the shape (32, 4)")
    assert "skillweave/" not in shown
    assert "direct cause" not in shown
    assert len(shown.splitlines()) < 25
    assert "In[3], line 4" in interrupted
    assert "Interrupted: saved at the start. Continue: " in interrupted
    assert "skillweave/" not in interrupted


@pytest.mark.slow
def test_ipython_shows_all_frames_where_the_switch_is_set(tmp_path):
    shown = in_ipython(tmp_path, SKILLWEAVE_TRACEBACK="1")
    assert "skillweave/skills/outputs.py" in shown
    assert "IndexError" in shown


class OutOfBounds(Skill):
    def reward(self, step: Any) -> Any:
        return step.next_obs[:, 9]  # reward fails


class Plain(Skill):
    pass


class Broken(World):
    def step(self, action: Any) -> Any:
        return {}["no such key"]  # step fails


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize(
    ("env", "skill", "who", "line"),
    [
        (
            "CartPole-v1",
            OutOfBounds(),
            r"out_of_bounds.*reward\(\) raised",
            "# reward fails",
        ),
        (Broken, Plain(), r"Broken: .*step 1 of its episode: step\(\) raised", "# step fails"),
    ],
)
def test_an_error_in_the_users_code_names_its_line_also_from_a_worker(
    tmp_path, workers, env, skill, who, line
):
    tiny = PPO(num_envs=2, n_steps=8, batch_size=16)
    spec = EnvSpec(env, workers=workers, engine="sync")
    hierarchy = Hierarchy(spec, [skill], algorithm=tiny, selector=tiny, steps=100)
    where = rf"\({HERE}, line {line_of(line)}\)"
    with pytest.raises(EnvError if env is Broken else SkillError, match=f"{who}.*{where}"):
        hierarchy.train(tmp_path / "run", quiet=True)


class Own(Memoryless):
    """A policy of the user's own."""

    def __init__(self) -> None:
        with gym.make("CartPole-v1") as env:
            self.observation_space, self.action_space = env.observation_space, env.action_space

    def act(self, memory: Any, obs: Any, mask: Any = None, **how: Any) -> Any:
        raise KeyError("left")  # act fails


class Fails(Skill):
    def policy(self, obs: Any) -> Any:
        return 1 / 0  # a policy fails


def test_an_error_in_a_policy_of_the_users_own_names_its_line(tmp_path):
    where = rf"KeyError: 'left' \({HERE}, line {line_of('# act fails')}\)"
    own = type("Ready", (Skill,), {"policy": Own()})()
    for skill, says in (
        (Fails(), rf"ZeroDivisionError.*\({HERE}, line {line_of('a policy fails')}\)"),
        (own, rf"skill 'ready': its policy's act\(\).*{where}"),
    ):
        with pytest.raises(PolicyError, match=says):
            Hierarchy("CartPole-v1", [skill]).train(tmp_path / "run", quiet=True)
    with pytest.raises(PolicyError, match=rf"the policy's act\(\) raised {where}"):
        evaluate(Own(), "CartPole-v1", episodes=1)


def test_an_error_of_the_librarys_own_is_not_blamed_on_the_user():
    def ours() -> None:
        exec(compile("1 / 0", str(LIBRARY / "collecting" / "calls.py"), "exec"), {})

    error = caught(ours)
    error.__traceback__ = error.__traceback__.tb_next.tb_next  # type: ignore[union-attr]
    with pytest.raises(ZeroDivisionError):
        blame(error, "the policy's act()")
