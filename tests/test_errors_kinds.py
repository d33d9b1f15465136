"""Each error has a kind: which kind a user's mistake has, and that no place raises the base class.

``test_mistakes.py`` has those whose words count, with their kinds.
"""

from __future__ import annotations

import ast
import importlib.util
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from skills.foreign_models import linear, onnx_file

import skillweave as sw
from skillweave import recipes
from skillweave.buffers import ram
from skillweave.cli.overrides import apply_overrides
from skillweave.collecting import search
from skillweave.collecting.workers import error_to_send
from skillweave.errors import (
    KINDS,
    EnvError,
    Interrupted,
    MissingExtra,
    kind_of,
    make_error,
    reworded,
)
from skillweave.hierarchy import options
from skillweave.runs.lock import Lock

ROOT = Path(__file__).parents[1] / "skillweave"
TINY = sw.Network((4,))
SMALL = sw.PPO(num_envs=2, n_steps=8, batch_size=16, update_epochs=1, network=TINY)


# No place raises the base class


def plain_errors(source: str) -> Iterator[str]:
    """Yield each line that makes or raises the base class of all errors."""
    for node in ast.walk(ast.parse(source)):
        made = node.func if isinstance(node, ast.Call) else None
        made = node.exc if isinstance(node, ast.Raise) else made
        if made is not None and ast.unparse(made).split(".")[-1] == "SkillweaveError":
            yield f"line {node.lineno}: {ast.unparse(node)[:80]}"
        if isinstance(node, ast.ClassDef) and "SkillweaveError" in map(ast.unparse, node.bases):
            yield f"line {node.lineno}: class {node.name}"


def test_the_search_finds_errors_without_a_kind():
    source = "raise SkillweaveError('x')\nx = sw.SkillweaveError('y')\nraise SkillweaveError\n"
    assert len(set(plain_errors(source))) == 3
    assert list(plain_errors("class A(SkillweaveError): ...")) == ["line 1: class A"]
    allowed = "try:\n    f()\nexcept SkillweaveError:\n    raise RunError('x') from None\n"
    assert list(plain_errors(allowed)) == []


def test_no_place_raises_an_error_without_a_kind():
    found = {
        str(path.relative_to(ROOT)): lines
        for path in ROOT.rglob("*.py")
        if path.name != "errors.py" and (lines := list(plain_errors(path.read_text())))
    }
    assert found == {}


# The tree


def test_the_kinds_are_one_level_below_their_base():
    assert all(issubclass(kind, sw.SkillweaveError) for kind in KINDS.values())
    assert issubclass(MissingExtra, ImportError)
    assert issubclass(Interrupted, KeyboardInterrupt)
    assert not issubclass(Interrupted, Exception)


@pytest.mark.parametrize("name", KINDS)
def test_an_error_of_each_kind_can_be_made_reworded_and_pickled(name):
    error = make_error(name, "first")
    again = reworded(error, "second")
    sent = pickle.loads(pickle.dumps(again))
    assert (type(error), type(again), type(sent)) == (KINDS[name],) * 3
    assert (str(error), str(again), str(sent)) == ("first", "second", "second")


def test_an_error_of_a_users_subclass_is_of_the_kind_that_it_stands_on():
    class Mine(EnvError):
        """A kind of the user's own."""

    assert kind_of(Mine("x")) == "EnvError"
    assert error_to_send(Mine("x")) == ("EnvError", "x")
    assert error_to_send(MissingExtra("a film", "video"))[0] == "MissingExtra"
    assert error_to_send(MemoryError("x"))[0] == "TrainingError"
    assert error_to_send(ValueError("x"))[0] == "EnvError"


# What users do wrong


class Line(gym.Env):
    """Two numbers, two actions, episodes of five steps."""

    observation_space: Any = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space: Any = gym.spaces.Discrete(2)
    pays: Any = 1.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(2, np.float32), self.info()

    def step(self, action):
        self.t += 1
        return np.zeros(2, np.float32), self.pays, self.t == 5, False, self.info()

    def info(self):
        return {}


SAME = Line()


class Raises(Line):
    def step(self, action):
        raise ValueError("the arm is stuck")


class Forbids(Line):
    def info(self):
        return {"action_mask": np.zeros(2, np.int8)}


class Far(Line):
    observation_space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)


class Plain(sw.Skill):
    def reward(self, step):
        return step.next_obs[:, 0]


def env(**members: Any) -> type[gym.Env]:
    return type("Own", (Line,), members)


def skill(**members: Any) -> sw.Skill:
    return type("S", (sw.Skill,), {"reward": Plain.reward} | members)()


def declare(place: Any = Line, skills: Any = None, **settings: Any) -> sw.Hierarchy:
    how: dict[str, Any] = {"steps": 64, "learn": "apart", "algorithm": SMALL, "selector": SMALL}
    return sw.Hierarchy(place, skills or [Plain()], **(how | settings))


def train(place: Any = Line, skills: Any = None, **settings: Any) -> sw.Run:
    return declare(place, skills, **settings).train("run", quiet=True)


def agent(place: Any = Line, algorithm: Any = SMALL, **how: Any) -> sw.Run:
    return sw.train_agent(place, algorithm, 32, "run", quiet=True, **how)


def ready(policy: Any, **members: Any) -> sw.Hierarchy:
    """A hierarchy whose only skill has a policy, and that selects by a function."""
    return declare(skills=[skill(policy=policy, **members)], selector=zeros)


def zeros(obs: Any) -> Any:
    return np.zeros(len(obs), int)


def play(hierarchy: sw.Hierarchy) -> Any:
    return hierarchy.train("run", quiet=True).evaluate(1, quiet=True)


def damaged(file: str, old: bytes, new: bytes) -> None:
    """Train, change a file of the run, and load it."""
    agent()
    path = Path("run") / file
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new))
    sw.Agent(Line, SMALL, 32).load("run")


def shortened_weights() -> None:
    agent()
    path = next(Path("run/policies").iterdir())
    path.write_bytes(path.read_bytes()[:-8])
    sw.Agent(Line, SMALL, 32).load("run")


def in_use() -> None:
    Path("run").mkdir()
    lock = Lock(Path("run"))
    try:
        Lock(Path("run"))
    finally:
        lock.release()


def trained_then(then: Callable[[], Any]) -> Any:
    agent()
    return then()


def diverges() -> Any:
    algorithm = sw.PPO(num_envs=2, n_steps=8, batch_size=16, learning_rate=1e30, network=TINY)
    return agent(algorithm=algorithm)


def no_start(patch: pytest.MonkeyPatch) -> Any:
    patch.setattr(search, "PATIENCE", 4)
    never = skill(name="never", initiation=lambda _, obs: np.zeros(len(obs), bool))
    return train(skills=[never, Plain()])


def short_memory(patch: pytest.MonkeyPatch) -> Any:
    patch.setattr(ram, "free_memory", lambda: 2**10)
    return agent(algorithm=sw.DQN(num_envs=2, buffer_size=10_000, learning_starts=8, network=TINY))


def endless_call(patch: pytest.MonkeyPatch) -> Any:
    patch.setattr(options, "LONGEST_EPISODE", 3)
    envs = sw.make_options_env(ready(zeros, max_steps=50), 1, 0.9)
    envs.reset(seed=0)
    return envs.step(np.array([0]))


def without_wandb(patch: pytest.MonkeyPatch) -> Any:
    patch.setattr(importlib.util, "find_spec", lambda name: None)
    return agent(track=["wandb"])


def other_observations() -> Any:
    pytest.importorskip("onnxruntime")
    return play(ready(sw.from_onnx(onnx_file(Path("x.onnx")))))


def no_model() -> Any:
    Path("x.onnx").write_bytes(b"\xff" * 40)
    return sw.from_onnx("x.onnx")


def looping_recipe() -> Any:
    Path("mine.py").write_text("import skillweave as sw\nsw.PPO(gamma=7)\n")
    return recipes.load("mine.py")


MISTAKES: dict[str, dict[str, Callable[..., Any]]] = {
    "DeclarationError": {
        "a guide without a use": lambda: train(guide=sw.Guide(3)),
        "a state without skills": lambda: sw.Automaton({"a": []}, {}),
        "a callback that is none": lambda: agent(callback=3),
        "an unknown recipe": lambda: recipes.load("no_such_recipe"),
        "a wrong setting in a recipe": looping_recipe,
        "a command line that names no setting": lambda: apply_overrides(declare(), ["gama=1"]),
    },
    "EnvError": {
        "step() raises in a process": lambda: agent(sw.EnvSpec(Raises, workers=2)),
        "a reward of NaN": lambda: agent(env(pays=float("nan"))),
        "a mask that allows nothing": lambda: agent(Forbids),
        "an environment that is none": lambda: agent(lambda: 3),
        "actions that nothing here can choose": lambda: agent(env(action_space=gym.spaces.Text(3))),
        "the same environment each time": lambda: agent(lambda: SAME),
        "no success to reach": lambda: agent(target_success=0.9, eval_every=16, eval_episodes=2),
        "a key of info that is no number": lambda: agent(
            env(info=lambda self: {"word": "x"}), log_info=["word"]
        ),
    },
    "SkillError": {
        "a reward of infinity": lambda: train(
            skills=[skill(reward=lambda _, step: np.full(len(step.obs), np.inf))]
        ),
        "reward() raises in a process": lambda: train(
            sw.EnvSpec(Line, workers=2), skills=[skill(reward=lambda _, step: 1 / 0)]
        ),
        "a reflex of floats": lambda: train(reflexes=[sw.Reflex(lambda obs: obs[:, 0] + 9.5, 0)]),
        "a call that never ends": endless_call,
    },
    "PolicyError": {
        "a file that is no ONNX model": no_model,
        "an ONNX model of other observations": other_observations,
        "a module of other observations": lambda: play(ready(sw.from_torch(linear()))),
        "a function that raises": lambda: play(ready(lambda obs: 1 / 0)),
        "a function that returns no action": lambda: play(ready(lambda obs: np.full(len(obs), 7))),
        "a zip that is not trusted": lambda: sw.from_sb3(__file__, "ppo"),
        "a policy in another environment": lambda: sw.evaluate(agent().policy, Far, episodes=1),
    },
    "TrainingError": {
        "training diverges": diverges,
        "a skill that may never start": no_start,
        "memory is short": short_memory,
    },
    "RunError": {
        "an edited run.json": lambda: damaged("run.json", b'"seed": 0', b'"seed": 1'),
        "a damaged run.json": lambda: damaged("run.json", b"{", b"["),
        "a file of weights that was cut": shortened_weights,
        "a run of other settings": lambda: trained_then(
            lambda: sw.Agent(Line, SMALL, 64).train("run", seed=4, quiet=True)
        ),
        "resuming with another seed": lambda: trained_then(
            lambda: sw.Agent(Line, SMALL, 32).train("run", seed=4, resume=True, quiet=True)
        ),
        "loading what was trained elsewhere": lambda: trained_then(
            lambda: sw.Agent(Far, SMALL, 32).load("run")
        ),
        "a run that is being trained": in_use,
        "an ONNX file that is not there": lambda: sw.from_onnx("nowhere.onnx"),
        "what another run did not learn": lambda: (
            train(skills=[skill(name="other")]),
            declare().train("new", start_from={"plain": "run"}, quiet=True),
        ),
    },
    "MissingExtra": {"a tracker that is not installed": without_wandb},
}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write runs into a folder of the test."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("kind", "label"), [(kind, label) for kind, labels in MISTAKES.items() for label in labels]
)
def test_a_mistake_has_its_kind(kind, label, monkeypatch):
    mistake = MISTAKES[kind][label]
    needs_patch = "patch" in getattr(mistake, "__annotations__", {})
    with pytest.raises(sw.SkillweaveError) as caught:
        mistake(*[monkeypatch][: int(needs_patch)])
    assert type(caught.value) is KINDS[kind], caught.value
