"""Typical mistakes of newcomers, and unusual but legal ways: what comes of each.

A mistake ends in an error of a kind, which names the thing, or in a warning; what is legal works.
"""

from __future__ import annotations

import dataclasses
import inspect
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from goals import worlds as goals
from parts import crane
from ready_selectors.chain import bound
from safetensors.torch import load_file
from toys import World

import skillweave as sw
from skillweave import recipes
from skillweave._internal.messages import ELSEWHERE, RECORDINGS, STARTS
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.cli.overrides import apply_overrides
from skillweave.envs import one_of
from skillweave.envs.make import make_engine
from skillweave.errors import KINDS, SkillError, SkillweaveError
from skillweave.networks.encoders import CellsEncoder
from skillweave.policies.sessions import open_session
from skillweave.skills.selector import FunctionSelector
from skillweave.spaces import action_codec, obs_codec
from skillweave.workers.shipping import packed

SMALL = sw.PPO(num_envs=4, n_steps=32, batch_size=32)
HER = sw.SAC(num_envs=4, learning_starts=10, hindsight=True)
FAST: dict[str, Any] = {"steps": 256, "learn": "apart", "algorithm": SMALL, "selector": SMALL}


def learning(**how):
    """A file that is to learn on, with a mapping that it cannot have: it is not opened."""
    return sw.from_onnx("m.onnx", **({"learn": True} | how))


class Good(sw.Skill):
    def reward(self, step):
        return step.next_obs[:, 0]


class Boom(World):
    def step(self, action):
        raise ValueError("boom")


class Wrong(World):
    def step(self, action):
        return np.zeros(3, np.float32), 0.0, False, False, {}


class Old(World):
    def step(self, action):
        return np.zeros(2, np.float32), 0.0, False, {}


class Forbids(World):
    def reset(self, **how):
        return super().reset(**how)[0], {"action_mask": np.zeros(2, np.int8)}


class Room(World):
    def __init__(self):
        parts = {"place": gym.spaces.Box(-1, 1, (2,)), "held": gym.spaces.Discrete(3)}
        super().__init__(gym.spaces.Dict(parts))


KEYS = "Dict with the keys 'held', 'place'"
PLACE = gym.spaces.Box(-1, 1, (1,))
OFF = type("Off", (Room,), {"see": lambda _: {"place": np.zeros(2, "f4"), "held": 3}})


def in_room(**attributes: Any) -> sw.Run:
    """Train one skill with these attributes where observations are a Dict."""
    return train(Room, [skill(**attributes)])


def declare(env: Any = "CartPole-v1", skills: Any = None, **settings: Any) -> sw.Hierarchy:
    return sw.Hierarchy(env, skills or [Good()], **(FAST | settings))


def train(*args: Any, **settings: Any) -> sw.Run:
    return declare(*args, **settings).train("runs/run", quiet=True)


def with_skill(**members: Any) -> sw.Run:
    """Train a skill with these methods and attributes."""
    return train(skills=[skill(**members)])


def skill(**members: Any) -> sw.Skill:
    return type("S", (sw.Skill,), members)()


def trained() -> sw.Hierarchy:
    """Leave a run in runs/ok."""
    found = declare()
    found.train("runs/ok", quiet=True)
    return found


def zeros(_: Any, obs: Any) -> Any:
    return np.zeros(len(obs), int)


def overwrite(_: Any, step: sw.Step) -> Any:
    step.next_obs[:, 0] = 0
    return step.reward


def file_in_the_way() -> None:
    Path("afile").write_text("x")
    declare().train("afile", quiet=True)


# By chance: CartPole has four numbers, and there are four environments.
AXIS = "the first axis of every array is that of the environments"
METHODS: dict[str, list[tuple[Callable[..., Any], str]]] = {
    "reward": [
        (lambda _, step: step.next_obs[:, :1], "shape (4, 1) at step 1, but (4,) was"),
        (lambda _, step: float(step.next_obs[0][0]), "one number for each of the 4"),
        (lambda _, step: step.next_obs[0, 0], "the first axis of every array"),
        (
            lambda _, step: step.next_obs[0],
            "reward() returned shape (4,) for 3 environments, but (3,) was expected; for 4 its "
            f"shape was right by chance: {AXIS}",
        ),
        (lambda _, step: step.next_obs[:, 0] * step.next_obs[0], "for 3 it raised ValueError"),
        (lambda _, step: np.full(len(step.obs), np.nan), "nan at step 1 for environment 0"),
        (lambda _, step: None, "returned None at step 1, but shape (4,) was expected: does it"),
        (lambda _, step: [[1.0], [1.0, 2.0]], "which is no array: ValueError"),
        (lambda _, step: ["a"] * len(step.obs), "returned <U1 ('a') at step 1, but rewards are"),
        (lambda _, step: [None] * len(step.obs), "returned object"),
        (lambda _, step: step.next_obs[:, 9], "step.next_obs has the shape (4, 4)"),
        (lambda _, step: step.next_observations[:, 0], "is 'next_obs' meant?"),
        (overwrite, "its argument is read-only: change a copy"),
    ],
    "termination": [
        (lambda _, step: step.next_obs[0] > 1, "shape (4,) for 3"),
        (lambda _, step: False, "shape () at step 1, but (4,) was expected: one yes or no for"),
        (lambda _, step: step.next_obs[:, 0], "is needed: return a comparison"),
        (lambda _, step: np.full(len(step.obs), 7), "7 at step 1 for environment 0, but yes or no"),
        (lambda _, step: np.full(len(step.obs), np.nan), "returned nan at step 1 for environment"),
        (lambda _, step: ["no"] * len(step.obs), "returned <U2 ('no')"),
        (lambda _, step: [None] * len(step.obs), "returned object"),
        (lambda _, step: np.full(len(step.obs), 1j), "returned complex128"),
        (lambda _, step: step.next_obs[:, 0] > 1 and step.next_obs[:, 1] > 0, "by & and |"),
        (lambda _, obs: obs[:, 0] > 1, "is a Step: write step.next_obs[:, 0]"),
        (lambda _, obs: obs.mean(axis=1) > 1, "is a Step: write step.next_obs[:, 0]"),
    ],
    "success": [
        (lambda _, step: np.full(len(step.obs), 7), "returned 7 at step 1"),
        (lambda _, step: step.next_obs[0] > 1, "shape (4,) for 3 environments"),
    ],
    "initiation": [
        (lambda _, obs: obs[0] > -9, "shape (4,) for 3 environments"),
        (lambda _, step: step.obs[:, 0] > 1, "not a Step: write obs[:, 0]"),
        (lambda _, obs: np.full(len(obs), 7), "returned 7"),
        (lambda _, obs: np.zeros(len(obs), bool), "Let at least one start everywhere"),
    ],
}
"""Methods of a skill, and words of the SkillError."""
MISTAKES: list[tuple[str, Callable[[], Any], str]] = [
    # EnvErrors
    ("EnvError", lambda: train("CartPol-v1"), "is 'CartPole-v1' meant?"),
    ("EnvError", lambda: train("LunarLander-v2"), "use `LunarLander-v3` instead"),
    ("EnvError", lambda: train("ALE/Pong-v5"), "install and import that package"),
    ("EnvError", lambda: train("procgen-v0"), "no environment 'procgen-v0'"),
    ("EnvError", lambda: train(Boom), "of its episode: step() raised ValueError"),
    ("EnvError", lambda: train(Wrong), "not in its observation_space"),
    ("EnvError", lambda: train(Forbids), "allows no action"),
    (
        "EnvError",
        lambda: sw.train_agent(lambda: World(gym.spaces.Discrete(1_000_000)), sw.PPO(), 64),
        "observations at once: 8.2 GB",
    ),
    (
        "EnvError",
        lambda: train(
            lambda: World(gym.spaces.Dict({"a.b": PLACE, "a": gym.spaces.Dict(b=PLACE)}))
        ),
        "two parts",
    ),
    (
        "EnvError",
        lambda: train(
            sw.EnvSpec(
                "CartPole-v1", wrappers=(lambda env: gym.wrappers.RecordVideo(env, "films"),)
            )
        ),
        "kwargs={'render_mode': 'rgb_array'}",
    ),
    ("EnvError", lambda: train(OFF), "observation['held'] is 3, which is not"),
    ("EnvError", lambda: train(Old), "returned 4 values; Gymnasium needs five"),
    (
        "EnvError",
        lambda: train(sw.EnvSpec("CartPole-v1", kwargs={"sutton_bartow_reward": True})),
        "sutton_bartow_reward",
    ),
    (
        "EnvError",
        lambda: sw.train_agent(
            "CartPole-v1", SMALL, 256, target_success=0.9, eval_every=128, eval_episodes=2
        ),
        "target_success",
    ),
    # DeclarationErrors
    ("DeclarationError", lambda: train(gym.make("CartPole-v1")), "it must be a Gymnasium id"),
    (
        "DeclarationError",
        lambda: with_skill(reward=lambda step: step.next_obs[:, 0]),
        "a skill takes (self, step)",
    ),
    (
        "DeclarationError",
        lambda: with_skill(initiation=lambda _, obs, goal: obs[:, 0] > 0),
        "called before the goal is chosen",
    ),
    (
        "DeclarationError",
        lambda: with_skill(reward=lambda _, step, goal: step.reward),
        "the goal is step.goal",
    ),
    (
        "DeclarationError",
        lambda: with_skill(goal_space=gym.spaces.Discrete(2), goals=lambda _, obs: obs),
        "with (obs, rng), but takes (obs)",
    ),
    ("DeclarationError", lambda: train(skills=[Good]), "write Center(), not Center"),
    ("DeclarationError", lambda: Good(max_steps=50), "write max_steps = 50 in the body"),
    ("DeclarationError", lambda: train(skills=Good()), "skills=[Center(), ...]"),
    ("DeclarationError", lambda: train(skills=[Good(), Good()]), "give one another name"),
    ("DeclarationError", lambda: sw.Hierarchy("CartPole-v1", []), "needs at least one skill"),
    ("DeclarationError", lambda: declare(skills=[skill(name="")]), "the class attribute 'name'"),
    ("DeclarationError", lambda: declare(call_steps=None), "give it max_steps or termination()"),
    ("DeclarationError", lambda: declare(reflexes=[zeros]), "an instance of Reflex"),
    ("DeclarationError", lambda: declare(skills=[skill(policy=sw.PPO)]), "policy is the class"),
    ("DeclarationError", lambda: recipes.load("no_such_recipe"), "no recipe or Python file"),
    ("DeclarationError", lambda: declare(skill_step=5), "'skill_steps' meant? It is"),
    ("DeclarationError", lambda: declare(skill_steps=5), "write apart=Apart(skill_steps="),
    ("DeclarationError", lambda: declare(restrict=True), "write guide=Guide(restrict=...)"),
    ("DeclarationError", lambda: declare(gamma=0.9), "write algorithm=PPO(gamma=...)"),
    ("DeclarationError", lambda: declare(seed=3), "write train(seed=...)"),
    (
        "DeclarationError",
        lambda: declare().train("runs/r", call_steps=5),
        "Hierarchy(call_steps=...)",
    ),
    (
        "DeclarationError",
        lambda: sw.train_agent("CartPole-v1", SMALL, 5, "runs/r", seeed=3),
        "'seed' meant",
    ),
    ("DeclarationError", lambda: sw.train_agent("CartPole-v1", SMALL), "train_agent() needs steps"),
    ("DeclarationError", lambda: setattr(declare(), "skill_steps", 5), "Apart(skill_steps="),
    (
        "DeclarationError",
        lambda: setattr(declare().apart, "skill_steps", 5),
        "replace(..., skill_steps=5)",
    ),
    (
        "DeclarationError",
        lambda: sw.PPO(num_envs=4, n_steps=8, batch_size=512),
        "batch_size is 512",
    ),
    (
        "DeclarationError",
        lambda: train("Pendulum-v1", skills=[skill()], algorithm=sw.DQN(num_envs=4)),
        "DQN cannot act in Box",
    ),
    ("DeclarationError", lambda: train(algorithm=sw.PPO), "write PPO(), not PPO"),
    ("DeclarationError", lambda: sw.TD3(hindsight=True), "n_step is 3; it must be 1"),
    (
        "DeclarationError",
        lambda: sw.SAC(hindsight=True, prioritized=True),
        "prioritized is True; it must be False",
    ),
    (
        "DeclarationError",
        lambda: train("Pendulum-v1", skills=[skill(algorithm=HER)], algorithm=SMALL),
        "hindsight, but it has no goals",
    ),
    (
        "DeclarationError",
        lambda: train("Pendulum-v1", [skill(algorithm=HER, goal_space=PLACE)], algorithm=SMALL),
        "define achieved_goal(self, obs)",
    ),
    (
        "DeclarationError",
        lambda: sw.train_agent("Pendulum-v1", HER, 6_000, "runs/r", quiet=True),
        "no 'achieved_goal' in its observations",
    ),
    ("DeclarationError", lambda: trained().load("runs/ok").evaluate(episode=5), "'episodes' meant"),
    (
        "DeclarationError",
        lambda: trained().load("runs/ok").evaluate(5, 3),
        "name the others, seed=...",
    ),
    ("DeclarationError", lambda: trained().load("runs/ok").render("x.avi"), ".gif or .mp4"),
    ("DeclarationError", lambda: trained().load("runs/ok").evaluate(0), "episodes is 0"),
    (
        "DeclarationError",
        lambda: train(reflexes=[sw.Reflex(lambda obs: obs[:, 0] > 0, action=5)]),
        "action returned 5, which is no action of",
    ),
    (
        "DeclarationError",
        lambda: declare().train("runs/tr", track=["tensorbord"]),
        "'tensorboard' meant",
    ),
    ("DeclarationError", lambda: declare(features="x"), "Hierarchy: features is 'x'"),
    (
        "DeclarationError",
        lambda: declare().train("runs/de", demonstrations="demos.npz"),
        "recorded",
    ),
    (
        "DeclarationError",
        lambda: sw.EnvSpec("CartPole-v1", initial_state=(0, 0, 0, 0)),
        "episodes start where",
    ),
    (
        "DeclarationError",
        lambda: sw.train_agent("CartPole-v1", SMALL, 16, reset_options={"low": -0.1}),
        "episodes start where",
    ),
    ("DeclarationError", lambda: declare(options=[Good()]), "is 'skills' meant?"),
    ("DeclarationError", lambda: in_room(sees=("hold",)), "is 'held' meant?"),
    ("DeclarationError", lambda: declare().train("runs/sd", seed="1"), "it must be a whole number"),
    # SkillErrors
    (
        "SkillError",
        lambda: train(reflexes=[sw.Reflex(lambda obs: obs[0] > 9, action=1, name="safe")]),
        "reflex 'safe': condition() returned shape (4,) for 3 environments",
    ),
    (
        "SkillError",
        lambda: train(
            reflexes=[
                sw.Reflex(lambda obs: obs[:, 0] > -9, lambda obs: (obs[0] > 0).astype(int), "safe")
            ]
        ),
        "reflex 'safe': action() returned shape (4,) for 3 environments",
    ),
    (
        "SkillError",
        lambda: (
            FunctionSelector(lambda obs: (obs[0] > 9).astype(int))
            .among(("left", "right"))
            .act({}, np.eye(4))
        ),
        "function <lambda>() returned shape (4,) for 3 environments",
    ),
    (
        "SkillError",
        lambda: train(reflexes=[sw.Reflex(lambda obs: obs[:, 0] + 9.5, 0)]),
        "(bool) is needed",
    ),
    (
        "SkillError",
        lambda: train(
            skills=[skill(policy=zeros)], selector=lambda obs: np.full(len(obs), "landd")
        ).evaluate(2),
        "'landd', which is no skill of the hierarchy; its skills are: s",
    ),
    (
        "SkillError",
        lambda: train(
            skills=[skill(policy=zeros)], selector=lambda obs: np.zeros(len(obs))
        ).evaluate(2),
        "whole numbers",
    ),
    ("SkillError", lambda: in_room(reward=lambda _, step: step.next_obs["hold"][:, 0]), KEYS),
    ("SkillError", lambda: in_room(reward=lambda _, step: step.next_obs[:, 0]), KEYS),
    ("SkillError", lambda: in_room(initiation=lambda _, obs: obs["hold"]), KEYS),
    # PolicyErrors
    (
        "PolicyError",
        lambda: sw.from_function(
            lambda obs: (obs[0] > 0).astype(int), action_space=gym.spaces.Discrete(2)
        ).act({}, np.eye(4)),
        "function <lambda>() returned shape (4,) for 3 environments",
    ),
    (
        "PolicyError",
        lambda: train(skills=[skill(policy=lambda _, obs: 1)]).evaluate(2),
        "one action of",
    ),
    (
        "PolicyError",
        lambda: train(skills=[skill(policy=lambda _, obs: np.full(len(obs), 7))]).evaluate(2),
        "returned 7, which is no action of Discrete(2)",
    ),
    # RunErrors
    ("RunError", file_in_the_way, "afile"),
    ("RunError", lambda: declare().train("/proc/x/run", quiet=True), "/proc/x/run"),
    ("RunError", lambda: declare().load("runs/nope"), "runs/nope holds no run"),
    (
        "RunError",
        lambda: (trained(), declare(skills=[skill(name="other")]).load("runs/ok")),
        "the skills good, but this hierarchy has other",
    ),
    (
        "RunError",
        lambda: (trained(), declare(skills=[skill(name="other")]).resume("runs/ok")),
        "the skills good, but this hierarchy has other",
    ),
    (
        "RunError",
        lambda: (trained(), declare("Acrobot-v1").load("runs/ok")),
        "trained on CartPole-v1",
    ),
    (
        "RunError",
        lambda: (trained(), sw.Agent("CartPole-v1", SMALL, 64).load("runs/ok")),
        "the run of a hierarchy, not of a plain agent",
    ),
    # Trainings: what is logged and kept, and their targets
    ("DeclarationError", lambda: declare().train("runs/k", keep="bst"), "keep is 'bst'; it must"),
    (
        "DeclarationError",
        lambda: declare().train("runs/l", log_info="fuel"),
        "log_info is 'fuel'; it must be a list of keys of info, such as ['",
    ),
    (
        "DeclarationError",
        lambda: declare().train("runs/l", log_info=["a", 3]),
        "log_info[1] is 3; it must be a key of info, such as 'distance'",
    ),
    ("DeclarationError", lambda: declare(skills=[skill(target_success=0.5)]), "define success()"),
]
"""The kind of the error, what is done, and words of its message."""


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write runs into a folder of the test, where no other test has registered an environment."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(gym.registry, "LunarLander-v2", raising=False)


@pytest.mark.parametrize(
    ("method", "function", "words"),
    [(method, *wrong) for method, tried in METHODS.items() for wrong in tried],
)
def test_a_method_that_is_wrong_is_an_error_that_names_the_thing(method, function, words):
    said = assert_refused(SkillError, words, lambda: with_skill(**{method: function}))
    assert f"{method}()" in said


def assert_refused(kind: type[SkillweaveError], words: str, mistake: Callable[[], Any]) -> str:
    with pytest.raises(SkillweaveError) as caught:
        mistake()
    assert type(caught.value) is kind
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def changed(**attributes: Any) -> None:
    """Train a hierarchy whose attributes were set after it was declared."""
    hierarchy = declare()
    for name, value in attributes.items():
        setattr(hierarchy, name, value)
    hierarchy.train("runs/changed", quiet=True)


CHANGED = {
    "learn": ("jointly", "it must be one of"),
    "apart": ({"skill_steps": 5}, "write Apart(skill_steps=5)"),
    "skills": ([Good], "write Center(), not Center"),
    "reflexes": (None, "each entry an instance of Reflex"),
    "env": (None, "it must be a Gymnasium id"),
}


@pytest.mark.parametrize("name", CHANGED)
def test_what_is_set_after_the_declaration_is_checked_as_well(name):
    value, words = CHANGED[name]
    with pytest.raises(SkillweaveError) as caught:
        changed(**{name: value})
    assert words in str(caught.value)
    assert not Path("runs/changed").exists()


def test_what_is_set_on_an_agent_a_skill_or_a_hierarchy_inside_is_checked_as_well():
    agent = sw.Agent("CartPole-v1", SMALL, 256)
    agent.steps = "many"
    with pytest.raises(SkillweaveError, match="steps is 'many'"):
        agent.train("runs/agent", quiet=True)
    hierarchy = declare()
    hierarchy.skills[0].max_steps = -3
    with pytest.raises(SkillweaveError, match="max_steps is -3"):
        hierarchy.train("runs/changed", quiet=True)
    inner = declare()
    outer = declare(skills=[inner, Good()])
    inner.call_steps = 0
    with pytest.raises(SkillweaveError, match="call_steps is 0"):
        outer.train("runs/outer", quiet=True)


WARNED = {
    "terminaton": ({"terminaton": lambda _, step: step.next_obs[:, 0] > 1}, "termination"),
    "done": ({"done": lambda _, step: step.next_obs[:, 0] > 1}, "termination"),
    "max_step": ({"max_step": 5}, "max_steps"),
    "rewards": ({"rewards": overwrite}, "reward"),
    "time_limit": ({"time_limit": 5}, "max_steps"),
    "predict": ({"predict": lambda _, obs: zeros(_, obs)}, "policy"),
    "rest": ({"rest": 0.0}, "Hierarchy.rest"),
}


@pytest.mark.parametrize("name", WARNED)
def test_a_misspelt_attribute_of_a_skill_is_a_warning(name):
    members, meant = WARNED[name]
    with pytest.warns(UserWarning, match=f"has '{name}', .* is '{meant}' meant"):
        declare(skills=[skill(**members)])
    mine = Good()
    vars(mine).update(members)
    with pytest.warns(UserWarning, match=f"has '{name}', .* is '{meant}' meant"):
        declare(skills=[mine])


def test_names_of_other_libraries_mean_names_that_exist():
    settings = (sw.Hierarchy, sw.EnvSpec, sw.PPO, sw.DQN, sw.Network, sw.TrainDefaults)
    known = {field.name for kind in settings for field in dataclasses.fields(kind)}
    known |= set(inspect.signature(sw.Run.evaluate).parameters) | set(vars(sw.Skill))
    known |= {f"Hierarchy.{field.name}" for field in dataclasses.fields(sw.Hierarchy)}
    assert len(ELSEWHERE) <= 30
    assert ELSEWHERE.keys() & known == {"rest"}  # which is a setting, and not of a skill
    assert set(ELSEWHERE.values()) <= known | {STARTS, RECORDINGS}


def test_names_that_a_skills_methods_use_are_its_own():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        declare(
            skills=[
                skill(
                    done=lambda self, step: step.next_obs[:, 0] > self.timeout,
                    termination=lambda self, step: self.done(step),
                    timeout=1.0,
                    goal=(1.0, 2.0),
                    far=2.0,
                    _success=lambda self, step: step.terminated,
                )
            ]
        )


class Draws(sw.Skill):
    """Legal, though its reward is random: it has a generator, and counts its calls."""

    def __init__(self) -> None:
        self.rng, self.calls = np.random.default_rng(0), 0

    def reward(self, step):
        self.calls += 1
        return self.rng.random(len(step.obs)) + np.random.rand()  # noqa: NPY002


LEGAL = {
    "reward as a tensor": {"reward": lambda _, step: torch.as_tensor(step.next_obs[:, 0])},
    "reward as a list": {"reward": lambda _, step: list(step.next_obs[:, 0])},
    "termination of 0 and 1": {
        "termination": lambda _, step: (step.next_obs[:, 0] > 1).astype(int)
    },
    "reward of what env says": {"reward": lambda _, step: step.reward * step.elapsed},
    "reward of info": {"reward": lambda _, step: step.info.get("x", np.zeros(len(step.obs)))},
    "a random reward": {"reward": lambda _, step: np.random.rand(len(step.obs))},  # noqa: NPY002
}


@pytest.mark.filterwarnings("ignore:The given NumPy array is not writable")
@pytest.mark.parametrize("label", LEGAL)
def test_unusual_but_legal_ways_work(label):
    assert with_skill(**LEGAL[label]).path.is_dir()


def test_looking_for_a_forgotten_axis_does_not_change_training(
    monkeypatch,
):
    def weights(run_dir: str) -> dict[str, Any]:
        np.random.seed(0)  # noqa: NPY002
        declare(skills=[Draws()]).train(run_dir, quiet=True)
        return load_file(Path(run_dir) / "policies" / "draws.safetensors")

    probed = weights("runs/probed")
    monkeypatch.setattr("skillweave.skills.outputs.look_at", lambda *_: None)
    plain = weights("runs/plain")
    assert plain.keys() == probed.keys()
    assert all(torch.equal(plain[name], probed[name]) for name in plain)


# Goals, parts, corrections, and what is wrong with one argument alone

POINT = goals.Point.observation_space
TEXT, THOUSAND = gym.spaces.Text(3), gym.spaces.Box(0, 999, (1,), np.int64)
ABSURD = gym.spaces.MultiDiscrete([2**60, 2**62])
BYTES = gym.spaces.Box(0, 255, (2,), np.uint8)
NESTED = gym.spaces.Dict({"at": gym.spaces.Box(-1, 1, (2,), np.float32), "byte": BYTES})
GO = "go_to"


def goes(chooses: Any, space: Any = "box") -> Any:
    """Evaluate a selector of a skill with goals, and one without."""
    made = goals.go_to()
    type(made).goal_space = goals.SPACES[space] if isinstance(space, str) else space
    if space is NESTED:
        type(made).reward = lambda self, step: step.goal["at"].sum(1)
        type(made).termination = type(made).success = lambda self, step: step.goal["at"][:, 0] > 9
    return goals.declared([made, goals.Rest()], selector=chooses).train(quiet=True).evaluate(2)


def fits(*skills: Any, **how: Any) -> None:
    """Check a hierarchy whose skills have goals."""
    goals.declared(list(skills) or [goals.go_to(), goals.Rest()], **how).check_spaces()


def each(name: Any, *given: Any) -> Any:
    """A selector of one skill everywhere, perhaps with goals."""
    return lambda obs: (np.full(len(obs), name), *given) if given else np.full(len(obs), name)


def options(actions: Any, space: Any = goals.SPACES["box"]) -> Any:
    """Take actions in an OptionsEnv of two environments."""
    skills = [goals.go_to(goal_space=space, policy=goals.walk), goals.Rest()]
    run = goals.declared(skills, selector=goals.rests).train(quiet=True)
    env = sw.envs.make_options_env(run, 2, 0.9)
    env.reset(seed=0)
    return env.step(actions)


def draws(drawn: Any) -> None:
    """Train a skill whose goals are drawn so."""
    goals.declared([goals.go_to(goals=drawn)]).train(quiet=True)


def player(goal: Any, space: str = "box", skill: Any = GO) -> sw.Player:
    """Let a ready skill act for a goal."""
    return goals.ready(space).player(skill=skill, goal=goal)


def planned(task: Any, **done: Any) -> None:
    """Plan for a task, or judge calls, on a log of calls that have goals."""
    run = goals.ready()
    log = run.log_calls(100)
    log.handover(done=done) if done else run.plan(task, log)


def sighted(sees: Any) -> None:
    """Check a network of a skill with goals that sees so much."""
    fits(goals.go_to(), algorithm=sw.PPO(network=sw.Network((8,), sees=sees)))


def at(goal: Any, *more: Any) -> Any:
    """An automaton whose states each go to a fixed goal."""
    states = {str(i): (GO, place) for i, place in enumerate((goal, *more))}
    return sw.Automaton(states, {})


def cranes(*skills: Any, env: Any = ("box",), **how: Any) -> Any:
    """Train a crane's skills, which have parts."""
    world = sw.EnvSpec(lambda: crane.Crane(*env), engine="sync", workers=1)
    return crane.crane(list(skills), env=world, **how).train(quiet=True)


def arm(**members: Any) -> Any:
    return type("Arm", (crane.Arm,), members)()


def middle(obs: Any) -> Any:
    return np.concatenate([-0.5 * obs["arm"], -0.25 * obs["hook"]], axis=1)


def ended(step: Any) -> Any:
    return step.terminated


def automaton(transitions: Any) -> Any:
    return sw.Automaton({"a": "wait", "b": "leave"}, transitions)


TWO = {"at": np.zeros((1, 2)), "side": np.zeros(1, int)}
TWICE = {"skill": np.zeros(2, int), "goal": {GO: np.array([[1, 1], [300, 1]])}}
WIDE = {"skill": [0, 0], "goal": {GO: np.zeros((2, 3))}}
IN_ROOMS: list[tuple[str, Callable[[], Any], str]] = [
    # Goals that a selector gives
    ("SkillError", lambda: goes(each(GO)), "chose skill 'go_to' without a goal"),
    ("SkillError", lambda: goes(lambda obs: (each(GO)(obs), obs[0])), "gave goals of shape"),
    ("SkillError", lambda: goes(lambda obs: (each(GO)(obs), obs + 9)), "is out of goal_space"),
    ("SkillError", lambda: goes(each("rest", {"rest": 1})), "'rest', which has no goals"),
    ("SkillError", lambda: goes(each("goto", np.zeros((1, 2)))), "'goto', which is no skill"),
    ("SkillError", lambda: goes(each(GO, {"go": np.zeros((1, 2))})), "'go', which is no skill"),
    ("SkillError", lambda: goes(sw.Automaton({"a": GO}, {})), "write ('go_to', goal)"),
    ("SkillError", lambda: goes(sw.tree.Sequence((GO, (1.0, 2.0, 3.0)))), "gave goals of shape"),
    ("SkillError", lambda: goes(at((0.5, (0.5, 1)))), "which are no goals of Box"),
    ("SkillError", lambda: goes(at(lambda obs: None)), "returned None, but goals"),
    ("SkillError", lambda: goes(lambda obs: (GO, (0.5, -0.5))), "return (names, goals)"),
    ("SkillError", lambda: goes(lambda obs: [(GO, 0.5)] * len(obs)), "(names, goals)"),
    ("SkillError", lambda: goes(lambda obs: ([GO] * len(obs), 0.5, 1)), "(names, goals)"),
    ("SkillError", lambda: goes(each(GO, {"at": TWO["at"]}), "dict"), "'at', 'side' was expected"),
    ("SkillError", lambda: goes(each(GO, {**TWO, "sid": 0}), "dict"), "['at', 'side', 'sid']"),
    ("SkillError", lambda: goes(each(GO, (0, 1, 2)), "tuple"), "a tuple of 2 parts"),
    ("SkillError", lambda: goes(at((0.5, 1.0), (1.0, 2.0, 3.0))), "goals of shape (1, 3)"),
    # Whole numbers of goals do not wrap around
    ("SkillError", lambda: goes(at((300, 300)), BYTES), "gave the goal [300, 300]"),
    ("SkillError", lambda: goes(at((-1, 7)), BYTES), "gave the goal [-1, 7]"),
    ("SkillError", lambda: goes(at((257, 0)), "bits"), "gave the goal [257, 0]"),
    ("SkillError", lambda: goes(at((3, 2**40)), "numbers"), "gave the goal [3, 1099511627776]"),
    (
        "SkillError",
        lambda: goes(lambda obs: ([GO] * len(obs), np.tile((300, 1), (len(obs), 1))), BYTES),
        "gave the goal [300, 1]",
    ),
    (
        "SkillError",
        lambda: goes(at(lambda obs: np.tile((257, 0), (len(obs), 1))), "bits"),
        "gave the goal [257, 0]",
    ),
    ("SkillError", lambda: goes(at({"at": (0.5, 0.5), "byte": (300, 1)}), NESTED), "part 'byte'"),
    ("SkillError", lambda: goes(at({"at": (0.5, 0.5), "byte": (1.5, 1)}), NESTED), "whole numbers"),
    ("SkillError", lambda: goes(at({"at": (0.5, 0.5), "byte": (1, 2, 3)}), NESTED), "of shape"),
    ("SkillError", lambda: options(TWICE, BYTES), "gave the goal [300, 1]"),
    # Goals that a skill draws, and goals of one skill alone
    ("SkillError", lambda: draws(lambda s, obs, rng: obs[0]), "shape (2,) for skill 'go_to'"),
    ("SkillError", lambda: draws(lambda s, obs, rng: None), "goals() returned None"),
    ("SkillError", lambda: draws(lambda s, obs, rng: obs.astype(str)), "goals() gave goals of <U"),
    ("SkillError", lambda: draws(lambda s, obs, rng: obs + 7), "goals() gave the goal ["),
    ("SkillError", lambda: draws(lambda s, obs, rng: obs.no), "goals() raised AttributeError"),
    ("SkillError", lambda: player((5, 5)), "the player gave the goal"),
    ("SkillError", lambda: player((0.5,)), "gave a goal of shape (1,) for skill 'go_to', but (2,)"),
    ("SkillError", lambda: player((257, 0), "bits"), "gave the goal [257, 0], which is out of"),
    ("SkillError", lambda: player({"at": (0, 0)}, "dict"), "a dict with 'at', 'side' was expected"),
    ("SkillError", lambda: player({"at": (0, 5), "side": 1}, "dict"), "out of goal_space"),
    ("SkillError", lambda: player({"at": (0,), "side": 1}, "dict"), "(1, 2) was expected"),
    ("SkillError", lambda: player(3, "tuple"), "the player gave"),
    ("DeclarationError", lambda: player((0, 0)).act(np.zeros((1, 2))), "without an axis"),
    ("DeclarationError", lambda: player((0, 0), skill=None), "policy that takes none: name a"),
    (
        "SkillError",
        lambda: goals.ready().evaluate(2, skill=GO, goal=(5, 5)),
        "evaluate() gave the goal [5.0, 5.0]",
    ),
    (
        "DeclarationError",
        lambda: goals.ready().evaluate(2, skill="rest", goal=(0, 0)),
        "skill 'rest' has no goals",
    ),
    ("DeclarationError", lambda: goals.ready().render("a.gif", goal=(0, 0)), "name it, skill="),
    ("DeclarationError", lambda: goals.ready().evaluate(2).goals, 'evaluate(skill="go_to")'),
    (
        "DeclarationError",
        lambda: goals.ready().evaluate(2, skill="rest").goals,
        "no skill with goals acted alone",
    ),
    # A task knows no goal
    ("SkillError", lambda: planned(GO), "step.goal: that is None here"),
    ("SkillError", lambda: planned(lambda step: step.goal[:, 0] > 0), "None here"),
    ("SkillError", lambda: planned(lambda step: step.next_obs > step.goal), "None here"),
    ("SkillError", lambda: planned(None, go_to=lambda step: step.goal[:, 0] > 0), "None here"),
    # Goals in an OptionsEnv
    ("DeclarationError", lambda: options([0, 1]), "goals for 'go_to'"),
    (
        "DeclarationError",
        lambda: options({"skill": [0], "goal": {GO: np.zeros((2, 2))}}),
        "are [0]",
    ),
    (
        "DeclarationError",
        lambda: options({"skill": [0, 2], "goal": {GO: [[0, 0]] * 2}}),
        "2 is no skill",
    ),
    ("SkillError", lambda: options(WIDE), "shape (2, 3) for skill 'go_to'"),
    # Selectors, skills and spaces of goals
    ("DeclarationError", lambda: fits(selector=sw.DQN()), "DQN cannot choose goals of Box"),
    ("DeclarationError", lambda: fits(goals.go_to("number"), selector=sw.TD3()), "TD3 cannot"),
    ("DeclarationError", lambda: fits(goals.go_to("picture"), selector=sw.PPO()), "PPO cannot"),
    (
        "SkillError",
        lambda: fits(goals.Rest(), selector=lambda obs: (["rest"] * len(obs), obs)),
        "but no skill",
    ),
    ("DeclarationError", lambda: fits(skill(goal_space=3)), "goal_space is 3"),
    ("DeclarationError", lambda: fits(skill(clip_goal=lambda s, o, g: g)), "set goal_space"),
    (
        "DeclarationError",
        lambda: fits(skill(goal_space=gym.spaces.Graph(gym.spaces.Discrete(2), None))),
        "is not supported",
    ),
    (
        "DeclarationError",
        lambda: fits(goals.go_to(goal_space=gym.spaces.Dict(at=POINT, word=gym.spaces.Text(4)))),
        "the part word of the goal_space",
    ),
    (
        "DeclarationError",
        lambda: fits(goals.go_to(goal_space=gym.spaces.Text(4), policy=goals.walk)),
        "is not supported",
    ),
    (
        "DeclarationError",
        lambda: fits(goals.go_to(goal_space=gym.spaces.Box(-1, 1, (0,)))),
        "which holds no number: leave it out",
    ),
    (
        "DeclarationError",
        lambda: fits(goals.go_to(goal_space=gym.spaces.Dict({1: POINT}))),
        "each with text as its name",
    ),
    (
        "DeclarationError",
        lambda: fits(
            selector=goals.SELECTOR,
            guide=sw.Guide(sw.Automaton({"a": {(GO, (0.5, 0.5)), "rest"}}, {})),
        ),
        "guide: it gives a goal",
    ),
    ("DeclarationError", lambda: sighted((0, 1)), "network.sees leaves out the goal"),
    ("DeclarationError", lambda: sighted("observation"), "network.sees leaves out the goal"),
    ("DeclarationError", lambda: sighted(("observatoin", "goal")), "is 'observation' meant"),
    ("PolicyError", lambda: fits(goals.go_to(policy=lambda self, obs: obs)), "takes no goal"),
    ("DeclarationError", lambda: fits(goals.go_to(policy=lambda s, o: o)), "takes (s, o), which"),
    ("PolicyError", lambda: fits(goals.go_to(policy=torch.nn.Linear(2, 2))), "write Goal() at its"),
    (
        "PolicyError",
        lambda: fits(goals.go_to(policy=sw.train_agent(goals.Point, goals.ON, 100).policy)),
        "has goals, but its policy observes Box",
    ),
    # Parts and corrections
    ("DeclarationError", lambda: crane.crane([skill(policy=crane.crane(), acts=0)]), "no acts of"),
    ("DeclarationError", lambda: cranes(skill(), rest="hold"), "no skill writes a part"),
    ("DeclarationError", lambda: cranes(arm(), rest="keep"), "rest is 'keep'; it must be"),
    ("DeclarationError", lambda: cranes(arm(acts=(0, 3))), "does not exist"),
    ("PolicyError", lambda: cranes(arm(policy=lambda s, o: np.zeros((len(o), 3)))), "was expected"),
    ("SkillError", lambda: cranes(arm(acts=(0,)), skill(), env=("one", True)), "allows none of"),
    ("DeclarationError", lambda: sw.Residual(None), "must be a function of observations"),
    ("DeclarationError", lambda: sw.Residual(middle, 0.0), "Residual.scale is 0.0"),
    ("DeclarationError", lambda: sw.Residual(middle, (0.1, -0.2)), "Residual.scale is"),
    ("DeclarationError", lambda: sw.Residual(sw.Residual(middle)), "Residual.policy is Residual"),
    ("DeclarationError", lambda: sw.Residual(goals.Rest), "is the class Rest"),
    ("DeclarationError", lambda: sw.Residual(goals.Rest()), "is the skill 'rest'"),
    ("DeclarationError", lambda: sw.Residual(crane.Arm), "is the class Arm"),
    ("DeclarationError", lambda: sw.Residual(arm()), "a skill that learns, and no policy"),
    (
        "DeclarationError",
        lambda: sw.Residual(crane.greedy([arm()]).as_skill("ready")),
        "the skill 'ready', and no policy",
    ),
    (
        "DeclarationError",
        lambda: cranes(skill(policy=sw.Residual(crane.greedy([arm()])))),
        "has a policy, but is none",
    ),
    ("DeclarationError", lambda: cranes(skill(policy=arm())), "is the skill 'arm'"),
    ("DeclarationError", lambda: learning(sees=("a", sw.LastAction())), "LastAction(), but"),
    ("DeclarationError", lambda: learning(sees=(sw.Elapsed(),)), "sees has Elapsed"),
    ("DeclarationError", lambda: learning(sees=(sw.Table([[1.0]]),)), "sees has Table"),
    ("DeclarationError", lambda: learning(sees=(sw.Part("a", history=3),)), "sees has history"),
    (
        "DeclarationError",
        lambda: learning(sees=(lambda obs, call: call.steps,)),
        "a function with call",
    ),
    ("DeclarationError", lambda: learning(every=2), "every is given"),
    ("DeclarationError", lambda: learning(chunk=4), "chunk is given"),
    ("DeclarationError", lambda: learning(state={"h": "g"}), "state is given"),
    ("DeclarationError", lambda: learning(acts=sw.Acts(ramp=5)), "acts has ramp"),
    ("DeclarationError", lambda: learning(acts=sw.Acts(to=(0,), rest=0.0)), "acts has to or rest"),
    ("DeclarationError", lambda: learning(learn="yes"), "learn is 'yes'"),
    (
        "DeclarationError",
        lambda: sw.Residual(sw.from_torch(torch.nn.Linear(3, 3), learn=True)),
        "leave out learn",
    ),
    (
        "DeclarationError",
        lambda: cranes(skill(policy=sw.Residual(lambda obs: [0])), env=("one",)),
        "needs a Box",
    ),
    (
        "DeclarationError",
        lambda: cranes(skill(policy=sw.Residual(middle, (0.1, 0.2)))),
        "the action has 3",
    ),
    ("DeclarationError", lambda: cranes(skill(policy=sw.Residual(5))), "is 5, which cannot act"),
    # Ready selectors
    ("DeclarationError", lambda: sw.Automaton({}, {}), "give at least one"),
    ("DeclarationError", lambda: sw.Automaton({"a": []}, {}), "'a' has no skill"),
    ("DeclarationError", lambda: sw.Automaton({"a": 3}, {}), "state 'a' has 3"),
    ("DeclarationError", lambda: sw.Automaton({"a": [3]}, {}), "has 3 among its"),
    ("DeclarationError", lambda: sw.Automaton({3: "wait"}, {}), "state is 3"),
    ("DeclarationError", lambda: sw.Automaton({"a": "b"}, {}, "x"), "names the state 'x'"),
    ("DeclarationError", lambda: automaton({("a", "c"): ended}), "names the state 'c'"),
    ("DeclarationError", lambda: automaton({"a": ended}), "from 'a'; write"),
    ("DeclarationError", lambda: automaton([ended]), "transitions are"),
    ("DeclarationError", lambda: automaton({("a", "b"): "won"}), "has the event 'won'"),
    ("DeclarationError", lambda: bound(sw.Automaton({"a": "fly"}, {})), "state 'a' names 'fly'"),
    ("DeclarationError", lambda: declare(selector=sw.Automaton), "an Automaton or a tree"),
    (
        "DeclarationError",
        lambda: declare(selector=each("good"), selection=sw.Selection(target_return=1.0)),
        "selector is ready",
    ),
    ("SkillError", lambda: declare(selector=each(7)).check_spaces(), "<lambda>() returned 7"),
    (
        "SkillError",
        lambda: declare(
            selector=sw.tree.Sequence(sw.tree.Condition(np.sign, "x"), "good")
        ).check_spaces(),
        "selector: tree: x() returned shape",
    ),
    (
        "DeclarationError",
        lambda: declare(selector=each("s"), skills=[skill(policy=zeros)], steps=None).plain_agent(),
        "no part of this hierarchy is trained",
    ),
    (
        "DeclarationError",
        lambda: apply_overrides(declare(selector=each("good")), ["selector.gamma=0.5"]),
        "selector.gamma: the selector is ready",
    ),
    ("DeclarationError", lambda: sw.tree.Sequence(), "Sequence has no children"),
    ("DeclarationError", lambda: sw.tree.Fallback("a", 3), "has the child 3"),
    ("DeclarationError", lambda: sw.tree.Sequence(sw.tree.Fallback), "has the child <class"),
    ("DeclarationError", lambda: sw.tree.Sequence("a", memory=1), "memory is 1"),
    ("DeclarationError", lambda: bound(sw.tree.Sequence(ended)), "tree has no skill"),
    ("DeclarationError", lambda: sw.tree.Condition("a"), "Condition is 'a'"),
    ("DeclarationError", lambda: bound(sw.tree.Sequence("fly")), "leaf names 'fly'"),
    # Names of arguments and attributes
    ("DeclarationError", lambda: sw.PPO(lr=1), "no setting 'lr': is 'learning_rate' meant"),
    ("DeclarationError", lambda: sw.PPO(Gamma=1), "is 'gamma' meant"),
    ("DeclarationError", lambda: sw.PPO(hidden=(8,)), "write network=Network(hidden=...)"),
    ("DeclarationError", lambda: sw.Network(zzzz=1), "there are: hidden, activation, layer_norm,"),
    ("DeclarationError", lambda: sw.DQN.rainbow(doble=True), "DQN has no setting 'doble'"),
    ("DeclarationError", lambda: dataclasses.replace(sw.SAC(), tua=1), "is 'tau' meant"),
    ("DeclarationError", lambda: setattr(sw.PPO(), "gama", 0.9), "is 'gamma' meant"),
    ("DeclarationError", lambda: sw.Reflex(print, acton=1), "no argument 'acton': is 'action'"),
    ("DeclarationError", lambda: sw.Reflex(print), "write Reflex(condition, action)"),
    ("DeclarationError", lambda: sw.tree.Sequence("a", memry=True), "is 'memory' meant"),
    ("DeclarationError", lambda: sw.evaluate(), "write evaluate(policy, env)"),
    ("DeclarationError", lambda: sw.envs.envpool("X"), "needs num_envs and threads and seed"),
    ("DeclarationError", lambda: declare(rnn=1), "algorithm=PPO(network=Network(rnn=...))"),
    ("DeclarationError", lambda: declare().train(gamma=1.0), "Hierarchy(algorithm=PPO(gamma="),
    ("DeclarationError", lambda: declare().load(verbose_=1), "there are: run_dir"),
    ("DeclarationError", lambda: sw.Hierarchy(), "write Hierarchy(env, skills)"),
    ("DeclarationError", lambda: sw.Hierarchy("CartPole-v1"), "Hierarchy needs skills: write"),
    ("DeclarationError", lambda: declare().load(), "needs run_dir: write load(run_dir)"),
    ("DeclarationError", lambda: sw.Hierarchy("X", [Good()], env="X"), "was given env twice"),
    ("DeclarationError", lambda: declare().load("x", "y"), "takes at most 1 of its arguments"),
    ("DeclarationError", lambda: setattr(declare(), "spec", 5), "spec is computed; it cannot be"),
    # An OptionsEnv
    (
        "DeclarationError",
        lambda: sw.envs.make_options_env(declare(), 2, 0.9),
        "skill 'good' has no policy",
    ),
    ("DeclarationError", lambda: sw.envs.make_options_env(declare(), 2, 2), "gamma is 2"),
    ("DeclarationError", lambda: sw.PPO(critic=sw.Network(planes="last")), "counts for both"),
    # Lengths of calls
    ("DeclarationError", lambda: sw.Lengths(), "Lengths"),
    ("DeclarationError", lambda: sw.Lengths(0, 4), "Lengths"),
    ("DeclarationError", lambda: sw.Lengths(4, 2), "Lengths"),
    ("DeclarationError", lambda: sw.Lengths(1, 2.5), "Lengths"),
    ("DeclarationError", lambda: sw.Lengths(..., 4), "Lengths"),
    ("DeclarationError", lambda: sw.Lengths(1, ...), "Lengths"),
    # Networks, and settings of algorithms that do not fit each other
    ("DeclarationError", lambda: sw.Network(sees=(0,), encoder="cells"), "give sees or encoder"),
    ("DeclarationError", lambda: sw.algorithms.CNN("plain", (), (), ()), "at least one layer"),
    ("DeclarationError", lambda: sw.algorithms.CNN(strides=(4, 2)), "have 3, 3 and 2"),
    (
        "DeclarationError",
        lambda: make_algorithm(
            sw.PPO(network=sw.Network(cnn=sw.algorithms.CNN())),
            gym.spaces.Box(0, 255, (20, 24, 3), np.uint8),
            POINT,
        ),
        "(3, 20, 24)",
    ),
    (
        "DeclarationError",
        lambda: make_algorithm(sw.SAC(target_entropy=1.2), POINT, gym.spaces.Discrete(3)),
        "at most 1.0",
    ),
    (
        "DeclarationError",
        lambda: make_algorithm(sw.SAC(target_entropy=1.5), POINT, POINT),
        "SAC.target_entropy is 1.5",
    ),
    # Skills and reflexes
    ("DeclarationError", lambda: skill(name=5).validate(), "name is 5; it must be a text"),
    ("DeclarationError", lambda: skill(reward=3).validate(), "reward is 3; it must be a method"),
    ("DeclarationError", lambda: sw.Reflex(3, 0), "Reflex's condition is 3"),
    ("DeclarationError", lambda: sw.Reflex(max, 0, 5), "Reflex's name is 5"),
    ("RunError", lambda: with_skill(policy="skill.onnx"), "skill.onnx does not exist"),
    ("DeclarationError", lambda: with_skill(policy="skill.pt"), "from_torch"),
    ("DeclarationError", lambda: with_skill(policy=3), "is 3, which cannot act"),
    ("DeclarationError", lambda: sw.Goal(low=1, high=0), "which is more than Goal.high"),
    ("DeclarationError", lambda: sw.Part("x", clip=(1, -1)), "Part.clip is (1, -1)"),
    # Spaces, and arguments of training
    ("EnvError", lambda: declare(lambda: World(TEXT)).check_spaces(), "observation space Text"),
    (
        "EnvError",
        lambda: declare(lambda: World(action_space=gym.spaces.Dict(x=TEXT))).check_spaces(),
        "part x of the action space, Text",
    ),
    (
        "EnvError",
        lambda: declare(lambda: World(action_space=THOUSAND)).check_spaces(),
        "not supported",
    ),
    (
        "EnvError",
        lambda: train(lambda: World(gym.spaces.MultiBinary(10**9))),
        "000 are supported: 64 units",
    ),
    (
        "EnvError",
        lambda: train(lambda: World(gym.spaces.Dict(a=ABSURD))),
        "000 are supported: 64 units",
    ),
    ("EnvError", lambda: train(lambda: World(action_space=ABSURD)), "000 are supported: 64 units"),
    (
        "TrainingError",
        lambda: train(algorithm=sw.PPO(n_steps=10**6, num_envs=10**6)),
        "lower num_envs or n_steps",
    ),
    ("DeclarationError", lambda: declare().train("runs/x", seed=-1), "seed is -1"),
    ("DeclarationError", lambda: declare().train(5), "run_dir is 5; it must be a path"),
    ("DeclarationError", lambda: declare().train("runs/x", track=5), "track is 5"),
    ("DeclarationError", lambda: declare().train("runs/x", evolve=3), "it must be Evolution()"),
    ("DeclarationError", lambda: declare(reflexes=3), "reflexes is 3; it must be a list"),
    ("DeclarationError", lambda: declare(skills=["x" * 10_000]), "xxx', which is not a Skill"),
    # One argument alone
    (
        "DeclarationError",
        lambda: make_algorithm(sw.PPO(epsilon=0.1), POINT, POINT),
        "epsilon needs discrete actions",
    ),
    (
        "DeclarationError",
        lambda: sw.PPO(
            learning_rate=sw.algorithms.Linear(1, 0), learning_rate_schedule="kl", target_kl=0.1
        ),
        "which adapts a number",
    ),
    ("EnvError", lambda: make_engine(sw.EnvSpec(World), 10**9), "1,000,000,000 environments"),
    ("EnvError", lambda: make_engine(sw.EnvSpec(World, engine="envpool"), 2), "EnvPool cannot run"),
    ("DeclarationError", lambda: one_of("CartPole-v1"), "one_of() got 'CartPole-v1'"),
    ("PolicyError", lambda: open_session(b"\x10\0\0\0ORTM" + b"\0" * 40, "it"), "cannot be run"),
    ("DeclarationError", lambda: CellsEncoder(obs_codec(POINT)), "images of whole numbers"),
    ("DeclarationError", lambda: sw.EnvSpec(World, obs_names=["x", "x"]), "obs_names"),
    ("DeclarationError", lambda: declare().train(resume=True), "name its directory"),
    (
        "PolicyError",
        lambda: sw.from_torch(torch.nn.Linear(4, 2)).act({}, np.eye(4, dtype="f4")),
        "has no spaces yet",
    ),
    (
        "PolicyError",
        lambda: sw.evaluate(sw.from_torch(torch.nn.Linear(3, 2)), "CartPole-v1", episodes=1),
        "fails on observations",
    ),
    ("EnvError", lambda: obs_codec(gym.spaces.Box(0, 1, (0,))), "holds no number"),
    ("EnvError", lambda: obs_codec(gym.spaces.Text(3)), "Box, Discrete, MultiDiscrete, MultiB"),
    ("EnvError", lambda: obs_codec(gym.spaces.Tuple((gym.spaces.Text(3),))), "Box, Discrete"),
    ("EnvError", lambda: obs_codec(gym.spaces.Tuple(())), "at least one part, each with text"),
    ("EnvError", lambda: obs_codec(gym.spaces.Dict([(1, BYTES)])), "each with text as its name"),
    ("EnvError", lambda: action_codec(gym.spaces.Text(2)), "MultiBinary, Box, and Dict and Tuple"),
    (
        "DeclarationError",
        lambda: packed({"a": threading.Lock()}, "the arm"),
        "the arm cannot be sent",
    ),
]
"""The kind of the error, what is done, and words of its message."""


@pytest.mark.parametrize(("kind", "mistake", "words"), [*MISTAKES, *IN_ROOMS])
def test_a_mistake_is_an_error_that_names_the_thing(kind, mistake, words):
    assert_refused(KINDS[kind], words, mistake)
