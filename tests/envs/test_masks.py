"""Action masks of environments: what infos say is what everyone who acts is told."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from toys import alone_in

from skillweave import (
    DQN,
    PPO,
    SAC,
    Apart,
    Hierarchy,
    Network,
    Selection,
    Skill,
    TrainDefaults,
    evaluate,
)
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.envs.env_infos import ActionMasks, random_actions
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import EnvError
from skillweave.experience.acting import Acting, Request
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.types import Array

# A gate shows the number of its episode.
pytestmark = pytest.mark.filterwarnings("ignore:.*(starts another episode|two resets)")
A = 4


def allowed_at(t: int, episode: int) -> Array:
    """What ``Gate`` allows: one or two of four actions, by the time and the episode."""
    mask = np.zeros(A, np.int8)
    mask[[(t + episode) % A, (2 * t + episode + 1) % A]] = 1
    return mask


class Gate(gym.Env):
    """Refuses what its mask forbids; episode e lasts 3 + e % 3 steps, odd ones are truncated.

    The observation is (episode, time). Nothing is allowed where an episode has terminated.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space: gym.Space[Any] = gym.spaces.Discrete(A)

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode, self.episode = render_mode, -1

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.episode, self.t = self.episode + 1, 0
        return self._told(False)

    def step(self, action: int) -> Any:
        if not allowed_at(self.t, self.episode)[action]:
            raise ValueError(f"{action} is forbidden at {self.t} of episode {self.episode}")
        self.t += 1
        ended, even = self.t == 3 + self.episode % 3, self.episode % 2 == 0
        obs, info = self._told(ended and even)
        return obs, float(action), ended and even, ended and not even, info

    def _told(self, over: bool) -> Any:
        mask = allowed_at(self.t, self.episode) * (not over)
        return np.array([self.episode, self.t], np.float32), {"action_mask": mask.astype(np.int8)}

    def render(self) -> Any:
        return np.zeros((8, 8, 3), np.uint8)


def wanted(obs: Array) -> Array:
    """The masks of observations (n, 2) that are not the last of a terminated episode."""
    return np.stack([allowed_at(int(t), int(e)) for e, t in obs]).astype(bool)


def first_allowed(mask: Array) -> Array:
    return mask.argmax(axis=1)


# Engines -----------------------------------------------------------------------------------------


def test_an_engine_knows_what_is_allowed_in_the_latest_observation_of_each_environment():
    engine = make_engine(EnvSpec(Gate, engine="sync"), 3)
    try:
        obs = engine.reset(0).copy()
        for ids in ([0, 1, 2], [2, 0], [2], None, [1, 2], [2, 1], None, None):
            mask = engine.mask()
            assert (mask.dtype, mask.shape) == (np.bool_, (3, A))
            assert mask.tolist() == wanted(obs).tolist()
            kept, rows = mask.copy(), np.arange(3) if ids is None else np.array(ids)
            raw = engine.step(first_allowed(mask)[rows], None if ids is None else rows)
            assert (mask == kept).all(), "what was given must not change"
            obs[rows] = raw.next_obs
            last = engine.mask()
            assert last[rows[raw.terminated]].all(), "nothing matters where it terminated"
            goes_on = rows[~raw.terminated]
            assert last[goes_on].tolist() == wanted(obs)[goes_on].tolist()
            if (ended := rows[raw.terminated | raw.truncated]).size:
                obs[ended] = engine.reset_some(ended)
    finally:
        engine.close()


def test_gymnasiums_taxi_is_driven_by_its_masks():
    engine = make_engine(EnvSpec("Taxi-v4"), 5)
    reference = gym.make("Taxi-v4").unwrapped
    rng = np.random.default_rng(0)
    obs = engine.reset(0)
    for _ in range(30):
        mask = engine.mask()
        assert mask.tolist() == [reference.action_mask(int(s)).tolist() for s in obs]
        action = random_actions(engine.action_space, 5, rng, mask)
        raw = engine.step(action)
        # every allowed move of Taxi's changes its state, so none was forbidden
        assert (raw.next_obs != obs).all()
        obs = raw.next_obs


def test_without_masks_everything_is_allowed():
    engine = make_engine(EnvSpec("CartPole-v1", engine="sync"), 2)
    engine.reset(0)
    assert engine.mask() is None
    engine.step(np.zeros(2, np.int64))
    assert engine.mask() is None
    masks = ActionMasks(gym.spaces.Box(-1, 1, (2,)), 2)
    masks.see({"action_mask": np.zeros((2, 2))})  # it is no mask of choices
    assert masks.now is None
    # Where one environment has no mask, everything is allowed there.
    masks = ActionMasks(gym.spaces.Discrete(3), 3)
    masks.see({})
    assert masks.now is None
    told = {
        "action_mask": np.array([[1, 0, 0], [0, 0, 0]]),
        "_action_mask": np.array([True, False]),
    }
    masks.see(told, np.array([2, 0]))
    assert masks.now.tolist() == [[True] * 3, [True] * 3, [True, False, False]]
    masks.see({}, np.array([2]))
    assert masks.now.all()


def test_a_mask_of_several_choices_has_their_numbers_one_after_another():
    space = gym.spaces.MultiDiscrete([2, 3])
    masks = ActionMasks(space, 2)
    masks.see({"action_mask": np.array([[1, 1, 0, 0, 1], [0, 1, 1, 1, 0]])})
    drawn = np.array(
        [random_actions(space, 2, np.random.default_rng(i), masks.now) for i in range(40)]
    )
    assert {tuple(a) for a in drawn[:, 0]} == {(0, 2), (1, 2)}
    assert {tuple(a) for a in drawn[:, 1]} == {(1, 0), (1, 1)}
    with pytest.raises(EnvError, match="environment 1 allows no action"):
        masks.see({"action_mask": np.array([[1, 1, 0, 0, 1], [1, 1, 0, 0, 0]])})


@pytest.mark.parametrize(
    "mask", [np.ones((2, 4)), np.ones(2), np.array([None, None]), np.array([["a"] * 3] * 2)]
)
def test_a_mask_of_another_shape_is_named(mask):
    masks = ActionMasks(gym.spaces.Discrete(3), 2)
    with pytest.raises(EnvError, match=r"action_mask.*shape \(2, 3\).*Discrete\(3\)"):
        masks.see({"action_mask": mask})


def test_a_mask_that_allows_nothing_names_the_environment_unless_the_episode_is_over():
    masks = ActionMasks(gym.spaces.Discrete(3), 4)
    told = {"action_mask": np.array([[0, 1, 0], [0, 0, 0]], np.int8)}
    masks.see(told, np.array([1, 3]), np.array([False, True]))
    assert masks.now[[1, 3]].tolist() == [[False, True, False], [True] * 3]
    with pytest.raises(EnvError, match=r"environment 3 allows no action.*action_mask"):
        masks.see(told, np.array([1, 3]), np.array([False, False]))


@pytest.mark.parametrize("start", [0, 5])
def test_random_actions_are_spread_over_what_is_allowed(start):
    space = gym.spaces.Discrete(4, start=start)
    mask = np.tile([True, False, True, False], (4000, 1))
    drawn = random_actions(space, 4000, np.random.default_rng(0), mask) - start
    assert set(drawn.tolist()) == {0, 2}
    assert abs((drawn == 0).mean() - 0.5) < 0.05


# Training ----------------------------------------------------------------------------------------


class Late(Skill):
    """May start where the time is 2, and stops by itself at 4."""

    def initiation(self, obs: Array) -> Array:
        return obs[:, 1] >= 2

    def termination(self, step: Any) -> Array:
        return step.next_obs[:, 1] == 4


SMALL = Network((8,))
LEARNERS = [
    PPO(num_envs=4, n_steps=16, batch_size=32, network=SMALL),
    DQN(num_envs=4, learning_starts=100, update_ratio=0.1, batch_size=8, network=SMALL),
    SAC(num_envs=4, learning_starts=100, update_ratio=0.1, batch_size=8, network=SMALL),
]


@pytest.mark.parametrize(
    ("algorithm", "at_random"),
    [(LEARNERS[0], False), (LEARNERS[1], False), (LEARNERS[1], True), (LEARNERS[2], False)],
    ids=["ppo", "dqn", "at random", "sac"],
)
@pytest.mark.parametrize("skill", [None, Skill(), Late()], ids=["agent", "skill", "late"])
def test_rows_have_the_masks_of_what_was_acted_on_and_of_true_successors(
    skill, algorithm, at_random
):
    # Gate raises an error where the learner, or the search for a start, takes what is forbidden.
    learner = make_algorithm(algorithm, Gate.observation_space, Gate.action_space)
    params = learner.acting_params(learner.init([Seeds(0)]), 0.0)
    collector = alone_in(make_engine(EnvSpec(Gate), 4), Acting([(learner, 1)], 4), skill)
    collector.start(Seeds(0))
    for i in range(3):
        asked = Request(30, (params,), np.array([0.9]), Seeds(i), at_random=at_random)
        experience = collector.collect(asked).batches[""]
        valid = experience.valid_rows
        assert valid.all() == (not isinstance(skill, Late))
        assert experience["mask"][valid].tolist() == wanted(experience["obs"][valid]).tolist()
        goes_on = valid & ~experience["terminated"]
        after = experience["next_mask"][goes_on]
        assert after.tolist() == wanted(experience["next_obs"][goes_on]).tolist()
        assert experience.ended[valid].sum() > 10


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("algorithm", LEARNERS, ids=lambda a: type(a).__name__)
def test_learnt_skills_selectors_and_flat_agents_never_take_what_is_forbidden(algorithm, tmp_path):
    # Gate raises an error at the first forbidden action: in training, looks, evaluation, videos.
    pytest.importorskip("PIL")
    hierarchy = Hierarchy(
        Gate,
        [Late(), type("Any", (Skill,), {"max_steps": 2})()],
        algorithm=algorithm,
        selector=LEARNERS[0],
        call_steps=3,
        apart=Apart(skill_steps=300, selector_steps=300),
        selection=Selection(greedy_skills=False),
        train_defaults=TrainDefaults(eval_every=200, eval_episodes=2),
        learn="apart",
    )
    run = hierarchy.train(tmp_path / "run", quiet=True)
    for how in ({"deterministic": False}, {"skill": "any"}, {}):
        assert run.evaluate(6, **how).mean > 0
        run.render(tmp_path / "a.gif", episodes=2, **how)
    flat = hierarchy.train(tmp_path / "flat", quiet=True, flat=True)
    assert flat.evaluate(6, deterministic=False).mean > 0
    flat.render(tmp_path / "a.gif", episodes=2)


# Policies made elsewhere ------------------------------------------------------------------------


def test_what_a_policy_made_elsewhere_takes_is_for_the_environment_to_judge():
    # Taxi stands still, and the others may raise: both are the environment's own rule.
    stubborn = ScriptedPolicy(lambda obs: np.full(len(obs), 5), *_spaces("Taxi-v4"))
    with pytest.warns(UserWarning, match=r"chose the action 5, which .* mask forbids"):
        found = evaluate(stubborn, EnvSpec("Taxi-v4"), episodes=2)
    assert found.lengths == (200, 200)
    stubborn = ScriptedPolicy(lambda obs: np.full(len(obs), 3), *_spaces(Gate))
    with (
        pytest.warns(UserWarning, match="chose the action 3, which .* mask forbids"),
        pytest.raises(EnvError, match=r"step 1 of its episode.*3 is forbidden"),
    ):
        evaluate(stubborn, EnvSpec(Gate), episodes=1)


def _spaces(env: Any) -> tuple[Any, Any]:
    made = EnvSpec(env).make()
    return made.observation_space, made.action_space
