"""Typical mistakes of newcomers, and unusual but legal ways: what comes of each.

A mistake ends in an error of a kind, which names the thing, or in a warning; what is legal works.
"""

from __future__ import annotations

import dataclasses
import inspect
import threading
import warnings
from collections.abc import Callable
from contextlib import nullcontext
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
from skillweave.spaces import obs_codec
from skillweave.workers.shipping import packed

SMALL = sw.PPO(num_envs=4, n_steps=32, batch_size=32)
FAST: dict[str, Any] = {"steps": 256, "learn": "apart", "algorithm": SMALL, "selector": SMALL}


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
        (
            lambda _, step: step.next_obs[:, :1],
            "reward() returned shape (4, 1) at step 1, but (4,) was expected",
        ),
        (lambda _, step: float(step.next_obs[0][0]), "one number for each of the 4 environments"),
        (
            lambda _, step: step.next_obs[0, 0],
            "one number for each of the 4 environments, the first axis of every array",
        ),
        (
            lambda _, step: step.next_obs[0],
            "reward() returned shape (4,) for 3 environments, but (3,) was expected; for 4 its "
            f"shape was right by chance: {AXIS}",
        ),
        (
            lambda _, step: step.next_obs[:, 0] * step.next_obs[0],
            "reward() answers for 4 environments, but for 3 it raised ValueError",
        ),
        (
            lambda _, step: np.full(len(step.obs), np.nan),
            "reward() returned nan at step 1 for environment 0: rewards must be finite",
        ),
        (
            lambda _, step: None,
            "reward() returned None at step 1, but shape (4,) was expected: does it lack a return?",
        ),
        (lambda _, step: [[1.0], [1.0, 2.0]], "which is no array: ValueError"),
        (
            lambda _, step: ["a"] * len(step.obs),
            "reward() returned <U1 ('a') at step 1, but rewards are real numbers",
        ),
        (lambda _, step: [None] * len(step.obs), "returned object"),
        (lambda _, step: step.next_obs[:, 9], "step.next_obs has the shape (4, 4)"),
        (lambda _, step: step.next_observations[:, 0], "is 'next_obs' meant?"),
        (overwrite, "its argument is read-only: change a copy"),
    ],
    "termination": [
        (
            lambda _, step: step.next_obs[0] > 1,
            "termination() returned shape (4,) for 3 environments",
        ),
        (
            lambda _, step: False,
            "termination() returned shape () at step 1, but (4,) was expected: one yes or no for",
        ),
        (
            lambda _, step: step.next_obs[:, 0],
            "but yes or no (bool) is needed: return a comparison",
        ),
        (
            lambda _, step: np.full(len(step.obs), 7),
            "termination() returned 7 at step 1 for environment 0, but yes or no",
        ),
        (lambda _, step: np.full(len(step.obs), np.nan), "returned nan at step 1 for environment"),
        (lambda _, step: ["no"] * len(step.obs), "termination() returned <U2 ('no')"),
        (lambda _, step: [None] * len(step.obs), "termination() returned object"),
        (lambda _, step: np.full(len(step.obs), 1j), "termination() returned complex128"),
        (
            lambda _, step: step.next_obs[:, 0] > 1 and step.next_obs[:, 1] > 0,
            "combine arrays by & and |, with each side in parentheses",
        ),
        (lambda _, obs: obs[:, 0] > 1, "its argument is a Step: write step.next_obs[:, 0]"),
        (lambda _, obs: obs.mean(axis=1) > 1, "its argument is a Step: write step.next_obs[:, 0]"),
    ],
    "success": [
        (lambda _, step: np.full(len(step.obs), 7), "success() returned 7 at step 1"),
        (lambda _, step: step.next_obs[0] > 1, "success() returned shape (4,) for 3 environments"),
    ],
    "initiation": [
        (lambda _, obs: obs[0] > -9, "initiation() returned shape (4,) for 3 environments"),
        (
            lambda _, step: step.obs[:, 0] > 1,
            "its argument is observations, not a Step: write obs[:, 0]",
        ),
        (lambda _, obs: np.full(len(obs), 7), "initiation() returned 7"),
        (lambda _, obs: np.zeros(len(obs), bool), "Let at least one start everywhere"),
    ],
}
"""Methods of a skill, and words of the SkillError."""
MISTAKES: dict[str, dict[str, tuple[Callable[[], Any], str]]] = {
    "EnvError": {
        "misspelt env id": (lambda: train("CartPol-v1"), "is 'CartPole-v1' meant?"),
        "old env id": (lambda: train("LunarLander-v2"), "use `LunarLander-v3` instead"),
        "env not imported": (lambda: train("ALE/Pong-v5"), "install and import that package"),
        "env of no package": (lambda: train("procgen-v0"), "no environment 'procgen-v0'"),
        "env raises in step": (lambda: train(Boom), "of its episode: step() raised ValueError"),
        "env returns a wrong shape": (lambda: train(Wrong), "not in its observation_space"),
        "a mask that allows nothing": (lambda: train(Forbids), "allows no action"),
        "a million one-hot numbers": (
            lambda: sw.train_agent(lambda: World(gym.spaces.Discrete(1_000_000)), sw.PPO(), 64),
            "computes with 4,096 observations at once: 16.4 GB",
        ),
        "two parts of one name": (
            lambda: train(
                lambda: World(
                    gym.spaces.Dict(
                        {
                            "a.b": gym.spaces.Discrete(2),
                            "a": gym.spaces.Dict(b=gym.spaces.Box(0, 1)),
                        }
                    )
                )
            ),
            "two parts",
        ),
        "RecordVideo without render_mode": (
            lambda: train(
                sw.EnvSpec(
                    "CartPole-v1",
                    wrappers=(lambda env: gym.wrappers.RecordVideo(env, "films"),),
                )
            ),
            "kwargs={'render_mode': 'rgb_array'}",
        ),
        "a wrong part of a Dict": (
            lambda: train(
                type("Off", (Room,), {"see": lambda _: {"place": np.zeros(2, "f4"), "held": 3}})
            ),
            "its observation['held'] is 3, which is not in Discrete(3)",
        ),
        "four values of old gym": (lambda: train(Old), "returned 4 values; Gymnasium needs five"),
        "misspelt keyword of an environment": (
            lambda: train(sw.EnvSpec("CartPole-v1", kwargs={"sutton_bartow_reward": True})),
            "sutton_bartow_reward",
        ),
        "no success to reach": (
            lambda: sw.train_agent(
                "CartPole-v1", SMALL, 256, target_success=0.9, eval_every=128, eval_episodes=2
            ),
            "target_success",
        ),
    },
    "DeclarationError": {
        "env instance": (lambda: train(gym.make("CartPole-v1")), "it must be a Gymnasium id"),
        "no self": (
            lambda: with_skill(reward=lambda step: step.next_obs[:, 0]),
            "a method of a skill takes (self, step)",
        ),
        "initiation takes a goal": (
            lambda: with_skill(initiation=lambda _, obs, goal: obs[:, 0] > 0),
            "initiation() is called with (obs), but takes (obs, goal): a method of a skill takes "
            "(self, obs); it is called before the goal is chosen",
        ),
        "reward takes a goal": (
            lambda: with_skill(reward=lambda _, step, goal: step.reward),
            "a method of a skill takes (self, step); the goal is step.goal",
        ),
        "goals without rng": (
            lambda: with_skill(goal_space=gym.spaces.Discrete(2), goals=lambda _, obs: obs),
            "goals() is called with (obs, rng), but takes (obs): ",
        ),
        "skill class": (lambda: train(skills=[Good]), "write Center(), not Center"),
        "skill with arguments": (
            lambda: Good(max_steps=50),
            "Good() takes no arguments: write max_steps = 50 in the body of the class",
        ),
        "one skill, no list": (lambda: train(skills=Good()), "skills=[Center(), ...]"),
        "two skills of one name": (lambda: train(skills=[Good(), Good()]), "give one another name"),
        "no skills": (lambda: sw.Hierarchy("CartPole-v1", []), "needs at least one skill"),
        "a skill without a name": (
            lambda: declare(skills=[skill(name="")]),
            "set the class attribute 'name'",
        ),
        "skills that never end": (
            lambda: declare(call_steps=None),
            "give it max_steps or termination()",
        ),
        "a function as a reflex": (lambda: declare(reflexes=[zeros]), "an instance of Reflex"),
        "a policy's class": (
            lambda: declare(skills=[skill(policy=sw.PPO)]),
            "skill 's': policy is the class",
        ),
        "an unknown recipe": (
            lambda: recipes.load("no_such_recipe"),
            "no recipe or Python file 'no_such_recipe'",
        ),
        "misspelt keyword of Hierarchy": (
            lambda: declare(skill_step=5),
            "is 'skill_steps' meant? It is a setting of apart: write apart=Apart(skill_steps=...)",
        ),
        "keyword of a group": (
            lambda: declare(skill_steps=5),
            "Hierarchy has no setting 'skill_steps'; it is a setting of apart: write "
            "apart=Apart(skill_steps=...)",
        ),
        "keyword of the guide": (lambda: declare(restrict=True), "write guide=Guide(restrict=...)"),
        "keyword of the algorithm": (
            lambda: declare(gamma=0.9),
            "it is a setting of algorithm: write algorithm=PPO(gamma=...)",
        ),
        "keyword of train": (
            lambda: declare(seed=3),
            "'seed'; it is an argument of train(): write train(seed=...)",
        ),
        "keyword of Hierarchy in train": (
            lambda: declare().train("runs/r", call_steps=5),
            "write Hierarchy(call_steps=...)",
        ),
        "misspelt keyword of train_agent": (
            lambda: sw.train_agent("CartPole-v1", SMALL, 5, "runs/r", seeed=3),
            "is 'seed' meant?",
        ),
        "train_agent without a budget": (
            lambda: sw.train_agent("CartPole-v1", SMALL),
            "train_agent() needs steps",
        ),
        "attribute of a group": (
            lambda: setattr(declare(), "skill_steps", 5),
            "it is a setting of apart: write apart=Apart(skill_steps=...)",
        ),
        "changed group": (
            lambda: setattr(declare().apart, "skill_steps", 5),
            "Apart cannot be changed: make another one, with "
            "dataclasses.replace(..., skill_steps=5)",
        ),
        "batch_size over a rollout": (
            lambda: sw.PPO(num_envs=4, n_steps=8, batch_size=512),
            "PPO.batch_size is 512",
        ),
        "DQN on continuous actions": (
            lambda: train("Pendulum-v1", skills=[skill()], algorithm=sw.DQN(num_envs=4)),
            "DQN cannot act in Box",
        ),
        "algorithm class": (lambda: train(algorithm=sw.PPO), "write PPO(), not PPO"),
        "misspelt keyword of evaluate": (
            lambda: trained().load("runs/ok").evaluate(episode=5),
            "is 'episodes' meant?",
        ),
        "seed by position": (
            lambda: trained().load("runs/ok").evaluate(5, 3),
            "evaluate() takes at most 1 of its arguments by position, but 2 were given: name the "
            "others, seed=... for example",
        ),
        "render to .avi": (lambda: trained().load("runs/ok").render("x.avi"), ".gif or .mp4"),
        "evaluate(0)": (lambda: trained().load("runs/ok").evaluate(0), "episodes is 0"),
        "reflex of a forbidden action": (
            lambda: train(reflexes=[sw.Reflex(lambda obs: obs[:, 0] > 0, action=5)]),
            "action returned 5, which is no action of Discrete(2)",
        ),
        "misspelt tracker": (
            lambda: declare().train("runs/tr", track=["tensorbord"]),
            "no tracker 'tensorbord': is 'tensorboard' meant?",
        ),
        "features as text": (lambda: declare(features="x"), "Hierarchy: features is 'x'"),
        "demonstrations": (
            lambda: declare().train("runs/de", demonstrations="demos.npz"),
            "recorded data",
        ),
        "other starts": (
            lambda: sw.EnvSpec("CartPole-v1", initial_state=(0, 0, 0, 0)),
            "EnvSpec has no setting 'initial_state': episodes start where",
        ),
        "other starts in train_agent": (
            lambda: sw.train_agent("CartPole-v1", SMALL, 16, reset_options={"low": -0.1}),
            "'reset_options': episodes start where",
        ),
        "options of the literature": (lambda: declare(options=[Good()]), "is 'skills' meant?"),
        "wrong key in sees": (lambda: in_room(sees=("hold",)), "is 'held' meant?"),
        "seed as text": (lambda: declare().train("runs/sd", seed="1"), "it must be a whole number"),
    },
    "SkillError": {
        "a reflex forgets the N axis by chance": (
            lambda: train(reflexes=[sw.Reflex(lambda obs: obs[0] > 9, action=1, name="safe")]),
            "reflex 'safe': condition() returned shape (4,) for 3 environments",
        ),
        "a reflex's action forgets the N axis by chance": (
            lambda: train(
                reflexes=[
                    sw.Reflex(
                        lambda obs: obs[:, 0] > -9, lambda obs: (obs[0] > 0).astype(int), "safe"
                    )
                ]
            ),
            "reflex 'safe': action() returned shape (4,) for 3 environments",
        ),
        "a selector forgets the N axis by chance": (
            lambda: (
                FunctionSelector(lambda obs: (obs[0] > 9).astype(int))
                .among(("left", "right"))
                .act({}, np.eye(4))
            ),
            "function <lambda>() returned shape (4,) for 3 environments",
        ),
        "a reflex of floats": (
            lambda: train(reflexes=[sw.Reflex(lambda obs: obs[:, 0] + 9.5, 0)]),
            "yes or no (bool) is needed",
        ),
        "selector of an unknown name": (
            lambda: train(
                skills=[skill(policy=zeros)], selector=lambda obs: np.full(len(obs), "landd")
            ).evaluate(2),
            "names 'landd', which is no skill of the hierarchy; its skills are: s",
        ),
        "selector of floats": (
            lambda: train(
                skills=[skill(policy=zeros)], selector=lambda obs: np.zeros(len(obs))
            ).evaluate(2),
            "whole numbers",
        ),
        "wrong key of a Dict": (
            lambda: in_room(reward=lambda _, step: step.next_obs["hold"][:, 0]),
            KEYS,
        ),
        "column of a Dict": (lambda: in_room(reward=lambda _, step: step.next_obs[:, 0]), KEYS),
        "wrong key in initiation": (lambda: in_room(initiation=lambda _, obs: obs["hold"]), KEYS),
    },
    "PolicyError": {
        "a policy forgets the N axis by chance": (
            lambda: sw.from_function(
                lambda obs: (obs[0] > 0).astype(int), action_space=gym.spaces.Discrete(2)
            ).act({}, np.eye(4)),
            "function <lambda>() returned shape (4,) for 3 environments",
        ),
        "policy of one action for all": (
            lambda: train(skills=[skill(policy=lambda _, obs: 1)]).evaluate(2),
            "one action of Discrete(2) for each",
        ),
        "policy of an action outside": (
            lambda: train(skills=[skill(policy=lambda _, obs: np.full(len(obs), 7))]).evaluate(2),
            "returned 7, which is no action of Discrete(2)",
        ),
    },
    "RunError": {
        "run_dir is a file": (file_in_the_way, "afile"),
        "run_dir not writable": (lambda: declare().train("/proc/x/run", quiet=True), "/proc/x/run"),
        "load of no run": (lambda: declare().load("runs/nope"), "runs/nope holds no run"),
        "load of another recipe": (
            lambda: (trained(), declare(skills=[skill(name="other")]).load("runs/ok")),
            "runs/ok was trained with the skills good, but this hierarchy has other",
        ),
        "resume of another recipe": (
            lambda: (trained(), declare(skills=[skill(name="other")]).resume("runs/ok")),
            "runs/ok was trained with the skills good, but this hierarchy has other",
        ),
        "load with another env": (
            lambda: (trained(), declare("Acrobot-v1").load("runs/ok")),
            "was trained on CartPole-v1",
        ),
    },
}
"""By the kind of the error: what is done, and words of its message."""


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write runs into a folder of the test, where no other test has registered an environment."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(gym.registry, "LunarLander-v2", raising=False)


@pytest.mark.parametrize(
    ("kind", "label"), [(kind, label) for kind, made in MISTAKES.items() for label in made]
)
def test_a_mistake_is_an_error_that_names_the_thing(kind, label):
    mistake, words = MISTAKES[kind][label]
    assert_refused(KINDS[kind], words, mistake)


@pytest.mark.parametrize(
    ("method", "function", "words"),
    [(method, *wrong) for method, tried in METHODS.items() for wrong in tried],
)
def test_a_method_that_is_wrong_is_an_error_that_names_the_thing(method, function, words):
    assert_refused(SkillError, words, lambda: with_skill(**{method: function}))


def assert_refused(kind: type[SkillweaveError], words: str, mistake: Callable[[], Any]) -> None:
    with pytest.raises(SkillweaveError) as caught:
        mistake()
    assert type(caught.value) is kind
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


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


def test_what_is_set_on_an_agent_or_a_skill_afterwards_is_checked_as_well():
    agent = sw.Agent("CartPole-v1", SMALL, 256)
    agent.steps = "many"
    with pytest.raises(SkillweaveError, match="steps is 'many'"):
        agent.train("runs/agent", quiet=True)
    hierarchy = declare()
    hierarchy.skills[0].max_steps = -3
    with pytest.raises(SkillweaveError, match="max_steps is -3"):
        hierarchy.train("runs/changed", quiet=True)


def test_what_is_set_on_a_hierarchy_inside_afterwards_is_checked_as_well():
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


def test_names_of_other_libraries_mean_names_that_exist():
    settings = (sw.Hierarchy, sw.EnvSpec, sw.PPO, sw.DQN, sw.Network, sw.TrainDefaults)
    known = {field.name for kind in settings for field in dataclasses.fields(kind)}
    known |= set(inspect.signature(sw.Run.evaluate).parameters) | set(vars(sw.Skill))
    known |= {f"Hierarchy.{field.name}" for field in dataclasses.fields(sw.Hierarchy)}
    assert len(ELSEWHERE) <= 30
    assert ELSEWHERE.keys() & known == {"rest"}  # which is a setting, and not of a skill
    assert set(ELSEWHERE.values()) <= known | {STARTS, RECORDINGS}


def test_a_misspelt_attribute_of_a_skills_instance_is_a_warning():
    mine = Good()
    mine.max_step = 5
    with pytest.warns(UserWarning, match="has 'max_step', .* is 'max_steps' meant"):
        declare(skills=[mine])


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


def test_training_without_a_directory_is_either_refused_or_makes_one():
    # Which of both depends on the signature of train().
    optional = inspect.signature(sw.Hierarchy.train).parameters["run_dir"].default is None
    with nullcontext() if optional else pytest.raises(SkillweaveError, match="needs run_dir"):
        assert declare().train(quiet=True).path.is_dir()


def test_a_resumed_run_goes_on_with_its_own_settings(capsys):
    trained()
    declare(call_steps=7).resume("runs/ok")
    assert "call_steps is 40 (declared now: 7)" in capsys.readouterr().err


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
    # Skills and reflexes
    ("DeclarationError", lambda: skill(name=5).validate(), "name is 5; it must be a text"),
    ("DeclarationError", lambda: skill(reward=3).validate(), "reward is 3; it must be a method"),
    ("DeclarationError", lambda: sw.Reflex(3, 0), "Reflex's condition is 3"),
    ("DeclarationError", lambda: sw.Reflex(max, 0, 5), "Reflex's name is 5"),
    ("DeclarationError", lambda: with_skill(policy="skill.onnx"), "from_onnx"),
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
    (
        "DeclarationError",
        lambda: packed({"a": threading.Lock()}, "the arm"),
        "the arm cannot be sent",
    ),
]
"""The kind of the error, what is done, and words of its message."""


@pytest.mark.parametrize(("kind", "mistake", "words"), IN_ROOMS)
def test_a_mistake_in_a_room_is_an_error_that_names_the_thing(kind, mistake, words):
    assert_refused(KINDS[kind], words, mistake)
