"""What depends on an environment or on skills says what has changed since, and only that."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym
import pytest
from shared_runs import SMALL

import skillweave as sw
from skillweave.calls import CallLog, join
from skillweave.errors import RunError
from skillweave.planning import Mission, Planner
from skillweave.runs.directory import CALLS
from skillweave.runs.user_code import changes, code_sum, environment_texts, skill_texts

SOURCE = '''
import json
import gymnasium as gym
import numpy as np
import skillweave as sw

GAIN, WALLS, COUNT, SEEN = 0.1, [0.9], 0, []

def move(place, action):
    return np.clip(place + GAIN * action, -1, 1)

class Base(gym.Env):
    def begin(self):
        return self.np_random.uniform(-1, 1, 2)

class Room(Base):
    """A room."""

    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    made = 0

    def __init__(self, gain=1):
        self.gain = gain
        Room.made += 1

    def reset(self, *, seed=None, options=None):
        global COUNT
        COUNT += 1
        SEEN.append(seed)
        super().reset(seed=seed)
        self.place, self.t = self.begin(), 0
        return self.place.astype(np.float32), {}

    def step(self, action):
        self.place, self.t = move(self.place, action * self.gain), self.t + 1
        over = bool(self.place[0] > WALLS[0])
        return self.place.astype(np.float32), 0.0, over, self.t >= 30, {}

    def render(self):
        return draw(self.place)

def draw(place):
    return place

class Mirror(gym.ActionWrapper):
    def action(self, action):
        return -action

def skill(way):
    class Move(sw.Skill):
        max_steps = 4

        def __init__(self, far=0.5):
            super().__init__()
            self.far = far

        def reward(self, step):
            return way * self.distance(step) + 0 * step.reward

        def distance(self, step):
            return np.abs(step.next_obs[:, 0] - self.far)

        def termination(self, step):
            return step.next_obs[:, 0] * step.reward > 9

        success = lambda self, step: step.next_obs[:, 0] > 0.4

        @staticmethod
        def policy(obs):
            return np.ones((len(obs), 2))

    move = Move()
    move.name = f"to_{way}".replace("-", "_")
    return move
'''


@pytest.fixture
def edited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    def edited(old: str = "", new: str = "", name: str = "room") -> Any:
        file = tmp_path / f"{name}.py"
        file.write_text(SOURCE.replace(old, new))
        module = ModuleType(name)
        module.__file__ = str(file)
        monkeypatch.setitem(sys.modules, name, module)
        exec(compile(file.read_text(), file, "exec"), vars(module))
        return module

    return edited


def texts(module: Any, way: int = 1, **spec: Any) -> dict[str, str]:
    skills = skill_texts({"move": module.skill(way)}, ())
    return environment_texts(sw.EnvSpec(module.Room, **spec)) | skills


EDITS = {
    "environment": [
        ("SEEN = 0.1", "SEEN = 0.2"),
        ("[0.9]", "[0.8]"),
        ("GAIN * action", "GAIN - action"),
        ("uniform(-1, 1, 2)", "uniform(0, 1, 2)"),
        ("gain=1", "gain=2"),
    ],
    "reward": [("far=0.5", "far=0.6"), ("np.abs", "np.square")],
    "termination": [("> 9", "> 8")],
    "success": [("> 0.4", "> 0.3")],
    "policy": [("np.ones", "np.zeros")],
    "": [
        ("A room.", "A large room."),
        ("self, action):", 'self, action: float) -> tuple:\n        "Step."'),
        ("self.gain = gain", "self.gain = (\n            gain  # swapped\n        )"),
        ("draw(self.place)", "0"),
        ("    return place\n", "    return 2 * place\n"),
        ("[0.9], 0, []", "[0.9], 7, [7]"),
    ],
}


@pytest.mark.parametrize("what", EDITS)
def test_an_edit_is_named_if_it_changes_what_happens(edited, what):
    before = texts(edited())
    for edit in EDITS[what]:
        says = changes(before, texts(edited(*edit)))
        assert (says.count("has changed") == 1 and what in says) if what else not says, edit


def test_values_in_closures_and_arguments_of_wrappers_count(edited):
    own, limit = edited(), gym.wrappers.TimeLimit
    assert "the reward" in changes(texts(own), texts(own, -1))
    assert "kwargs" in changes(texts(own), texts(own, kwargs={"gain": 2}))
    assert "Mirror" in changes(texts(own), texts(own, wrappers=(own.Mirror,)))
    for wrap in (
        lambda n: lambda env: limit(env, n),
        lambda n: functools.partial(limit, max_episode_steps=n),
    ):
        one, same, other = (texts(own, wrappers=(wrap(n),)) for n in (9, 9, 8))
        assert not changes(one, same)
        assert "wrappers" in changes(one, other)


def test_use_place_and_process_change_nothing(edited, tmp_path):
    scope: dict[str, Any] = {}
    exec("reward = lambda step: step.reward", scope)
    assert code_sum(scope["reward"]) == "", "code from text has no module and no sum"
    own = edited()
    before = texts(own)
    own.Room().reset(seed=1)
    made: dict[str, Any] = {"__name__": "made"}
    exec(SOURCE.replace("GAIN *", "GAIN -"), made)  # without source
    for now in (texts(own), environment_texts(sw.EnvSpec(made["Room"])), texts(edited(name="b"))):
        assert not changes(before, now) + changes(now, before)
    main = tmp_path / "main.py"
    main.write_text(
        SOURCE + "from skillweave.runs.user_code import *\nprint(json.dumps(environment_texts("
        "sw.EnvSpec(Room)) | skill_texts({'move': skill(1)}, ())))"
    )
    env = os.environ | {"PYTHONHASHSEED": "7", "PYTHONPATH": os.pathsep.join(sys.path)}
    assert json.loads(subprocess.check_output([sys.executable, main], env=env)) == before


def declare(module: Any, **how: Any) -> sw.Hierarchy:
    spec = sw.EnvSpec(module.Room, engine="sync", workers=1)
    skills, how = [module.skill(1), module.skill(-1)], {"selector": SMALL, "call_steps": 3} | how
    return sw.Hierarchy(spec, skills, apart=sw.Apart(selector_steps=100), **how)


def used_log(run: sw.Run) -> CallLog:
    return CallLog.load(run.path / CALLS)


def planner(run: sw.Run) -> Planner:
    return Planner(used_log(run), Mission(lambda obs: obs[:, 0] > 0.2))


def guided(own: Any, run: sw.Run) -> sw.Hierarchy:
    return declare(own, guide=sw.Guide(planner(run), restrict=False, target_kl=0.1))


USES: dict[str, Any] = {
    "load": lambda own, run, path: declare(own).load(run.path),
    "resume": lambda own, run, path: declare(own).train(run.path, resume=True),
    "weights": lambda own, run, path: declare(own).load_weights(f"{run.path}.safetensors"),
    "start": lambda own, run, path: declare(own).train(path, start_from=run),
    "selector": lambda own, run, path: declare(own, selector=planner(run)).train(path),
    "guide": lambda own, run, path: guided(own, run).train(path),
    "plan": lambda own, run, path: declare(own).train(path).plan("to_1", used_log(run)),
}


@pytest.fixture
def run(edited: Any, tmp_path: Path) -> sw.Run:
    run = declare(edited()).train(tmp_path / "run", quiet=True)
    run.log_calls(400)
    run.save_weights(tmp_path / "run.safetensors")
    return run


@pytest.mark.parametrize("use", USES)
def test_each_use_says_once_that_the_environment_has_changed(edited, run, use, capfd):
    for edit, times in ((("GAIN *", "GAIN -"), 1), (("A room.", "My room."), 0)):
        with warnings.catch_warnings(record=True) as given:
            warnings.simplefilter("default")
            USES[use](edited(*edit), run, run.path.with_name(edit[1]))
        said = " ".join((*map(str, given), *capfd.readouterr()))
        assert said.count("the code of the environment has changed") == times


@pytest.mark.filterwarnings("ignore:the .* of skill .* has changed since .* trained")
def test_a_log_is_refused_where_calls_would_end_elsewhere(edited, run):
    def skills(*edit: str) -> Any:
        policy: Any = declare(edited(*edit)).load(run.path).policy
        return policy.skills

    used_log(run).check_skills(skills("np.abs", "np.square"))  # another reward
    with pytest.raises(RunError, match="the termination of skill 'to_1' has changed"):
        used_log(run).check_skills(skills("> 9", "> 8"))


def test_a_run_that_goes_on_with_another_reward_says_so_once(edited, tmp_path):
    def learning(steps: int, far: float) -> sw.Hierarchy:
        own = edited("    @staticmethod\n        def policy", "    def unused")
        skills = [own.skill(1), own.skill(-1)]
        skills[0].far = far
        apart = sw.Apart(skill_steps=steps, selector_steps=steps)
        how: Any = {"algorithm": SMALL, "selector": SMALL, "learn": "apart", "call_steps": 3}
        return sw.Hierarchy(own.Room, skills, apart=apart, **how)

    learning(100, 0.5).train(tmp_path / "run", quiet=True)
    with pytest.warns(UserWarning, match="the reward of skill 'to_1' has changed"):
        learning(200, 0.7).train(tmp_path / "run", resume=True, quiet=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        learning(200, 0.7).load(tmp_path / "run")


@pytest.mark.filterwarnings("ignore:the code of the environment has changed since .* trained")
def test_logs_of_two_environments_are_not_mixed(edited, run):
    now = declare(edited("GAIN *", "GAIN -")).load(run.path)
    with pytest.warns(UserWarning, match=r"They are now in calls-1\.safetensors"):
        new = now.log_calls(100)
    assert len(now.calls) == len(new)
    with pytest.raises(RunError, match="the code of the environment has changed"):
        join([CallLog.load(run.path / "calls-1.safetensors"), new])
