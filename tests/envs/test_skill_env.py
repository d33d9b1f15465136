"""A vector seen through a skill equals a scalar loop, with whatever engine."""

import numpy as np
import pytest
from skillweave.envs.skill_env import SkillEnv
from toys import Ledger, actions, cartpole

from skillweave.envs.make import EnvSpec, make_engine
from skillweave.seeding import Seeds
from skillweave.skills import Reflex, Skill
from skillweave.types import SkillweaveError

pytestmark = pytest.mark.filterwarnings("ignore:.*precision lowered")
GYMNASIUM = ["sync", "async"]
ENGINES = ["envpool", *GYMNASIUM]
TAG, EPISODE, STEP, ACTION = range(4)


@pytest.fixture
def skill_env():
    """Makes environments, and closes them in the end."""
    made = []

    def make(name: str = "sync", env=Ledger, skill=None, num_envs: int = 3, reflexes=()):
        if name == "envpool":
            pytest.importorskip("envpool")
        engine = make_engine(EnvSpec(env, engine=name), num_envs, threads=1)
        made.append(SkillEnv(engine, skill, reflexes))
        return made[-1]

    yield make
    for env in made:
        env.close()


@pytest.mark.parametrize("name", GYMNASIUM)
def test_every_transition_is_that_of_a_scalar_loop(skill_env, name):
    vector = skill_env(name)
    rng = np.random.default_rng(0)
    scalars = [Ledger() for _ in range(3)]
    obs = vector.reset(Seeds(0))
    before = [s.reset()[0] for s in scalars]
    for _ in range(30):
        action = rng.integers(3, size=3)
        step = vector.step(action)
        assert step.steps.tolist() == [1, 1, 1]
        assert step.mask is None
        for i, scalar in enumerate(scalars):
            assert obs[i, 1:].tolist() == before[i][1:].tolist()
            next_obs, reward, terminated, truncated, _ = scalar.step(int(action[i]))
            assert step.next_obs[i, 1:].tolist() == next_obs[1:].tolist()
            assert step.next_obs[i, TAG] == obs[i, TAG], "the successor is of another episode"
            assert step.reward[i] == reward
            assert (step.terminated[i], step.truncated[i]) == (terminated, truncated)
            ended = terminated or truncated
            assert step.ended[i] == ended
            before[i] = scalar.reset()[0] if ended else next_obs
            assert (step.obs[i, TAG] != obs[i, TAG]) == ended
        obs = step.obs.copy()


@pytest.mark.parametrize("name", ENGINES)
def test_no_step_is_ignored_and_none_invented(skill_env, name):
    env = skill_env(name, "CartPole-v1")
    obs, ends = env.reset(Seeds(0)).copy(), 0
    for t in range(60):
        action = actions(3, 0) if t % 3 else actions(3, 1)
        step = env.step(action)
        for before, a, after in zip(obs, action, step.next_obs, strict=True):
            np.testing.assert_allclose(after, cartpole(before, a), atol=1e-5)
        ended = step.ended
        ends += ended.sum()
        assert np.array_equal(step.obs[~ended], step.next_obs[~ended])
        assert (np.abs(step.obs[ended]) <= 0.05).all()
        assert (np.abs(step.next_obs[ended][:, 2]) > 0.2).all()
        obs = step.obs.copy()
    assert ends > 5


def test_envpools_lander_takes_a_real_step_after_each_reset(skill_env):
    pytest.importorskip("Box2D")
    env = skill_env("envpool", "LunarLander-v3")
    obs, fresh, length = env.reset(Seeds(0)).copy(), np.ones(3, bool), np.zeros(3, int)
    ends = 0
    for _ in range(400):
        step = env.step(np.zeros(3, np.int64))
        length += 1
        assert step.info["elapsed_step"].tolist() == length.tolist()
        assert (np.abs(step.next_obs - obs).max(1) > 0).all()
        assert (step.reward != 0).all()
        assert (step.obs[step.ended, 1] > 1.3).all(), "a new episode starts at the top"
        if step.ended.any():
            assert step.info["length"].tolist() == length.tolist()
        ends += step.ended.sum()
        length[step.ended] = 0
        obs, fresh = step.obs.copy(), step.ended
    assert ends > 5
    assert not fresh.all()


@pytest.mark.parametrize("name", ENGINES)
def test_the_same_seeds_give_the_same_observations(skill_env, name):
    class Late(Skill):
        def initiation(self, obs):
            return np.abs(obs[:, 3]) > 0.2  # so that random actions are taken first

    env = skill_env(name, "CartPole-v1", Late())

    def play(seed: int) -> np.ndarray:
        seen = [env.reset(Seeds(seed)).copy()]
        seen += [env.step(actions(3, t)).obs.copy() for t in range(25)]
        return np.stack(seen)

    first = play(1)
    assert np.array_equal(play(1), first)
    assert not np.array_equal(play(2)[0], first[0])


@pytest.mark.parametrize("name", ENGINES)
def test_max_steps_truncates_and_really_resets(skill_env, name):
    class Short(Skill):
        max_steps = 3

    env = skill_env(name, "CartPole-v1", Short())
    obs = env.reset(Seeds(0)).copy()
    for t in range(1, 10):
        step = env.step(np.ones(3, np.int64))
        for before, after in zip(obs, step.next_obs, strict=True):
            np.testing.assert_allclose(after, cartpole(before, 1), atol=1e-5)
        assert not step.terminated.any()
        assert step.truncated.tolist() == [t % 3 == 0] * 3
        if t % 3 == 0:
            assert (step.next_obs[:, 1] > 0.4).all(), "not the true successor"
            assert (np.abs(step.obs) <= 0.05).all(), "not reset"
        obs = step.obs.copy()


def test_a_skills_termination_terminates_and_resets_at_once(skill_env):
    class UntilTwo(Skill):
        max_steps = 2  # on the same step: then the termination counts

        def termination(self, step):
            return step.next_obs[:, STEP] == 2

    env = skill_env(skill=UntilTwo())
    env.reset(Seeds(0))
    for _ in range(5):
        assert not env.step(np.zeros(3, np.int64)).ended.any()
        step = env.step(np.zeros(3, np.int64))
        assert step.terminated.all()
        assert not step.truncated.any()
        assert (step.next_obs[:, STEP] == 2).all()
        assert (step.obs[:, STEP] == 0).all()
    assert (step.obs[:, EPISODE] == 5).all()


def test_a_skill_sees_the_whole_step_and_its_reward_replaces_the_tasks(skill_env):
    seen = []

    class Watch(Skill):
        max_steps = 2

        def reward(self, step):
            seen.append(step)
            return step.next_obs[:, STEP] - 0.5 * step.elapsed

        def success(self, step):
            return step.action == 2

    env = skill_env(skill=Watch(), num_envs=2)
    obs = env.reset(Seeds(0)).copy()
    for t in range(4):
        action = np.array([t % 3, 2])
        step = env.step(action)
        (told,) = seen[t:]
        assert np.array_equal(told.obs, obs)
        assert np.array_equal(told.action, action)
        assert np.array_equal(told.next_obs, step.next_obs)
        assert told.reward.tolist() == [10 * (t % 2 + 1) + t % 3, 10 * (t % 2 + 1) + 2]
        assert told.timed_out.tolist() == [t % 2 == 1 and not told.terminated[0]] * 2
        assert step.reward.tolist() == [0.5 * (t % 2 + 1)] * 2
        assert step.reward.dtype == np.float32
        assert np.array_equal(step.info["task_reward"], told.reward)
        assert step.info["success"].tolist() == [t % 3 == 2, True]
        obs = step.obs.copy()


def test_elapsed_counts_from_one_in_every_episode(skill_env):
    elapsed = []

    class Count(Skill):
        def reward(self, step):
            elapsed.append(step.elapsed.copy())
            return step.reward

    env = skill_env(skill=Count())
    env.reset(Seeds(0))
    for _ in range(20):
        step = env.step(np.zeros(3, np.int64))
        assert np.array_equal(elapsed[-1], step.next_obs[:, STEP])


def test_a_call_starts_only_where_the_skill_may_start(skill_env):
    class FromStepTwo(Skill):
        max_steps = 1

        def initiation(self, obs):
            return obs[:, STEP] == 2

    env = skill_env(skill=FromStepTwo())
    obs = env.reset(Seeds(0))
    for _ in range(10):
        assert (obs[:, STEP] == 2).all()
        step = env.step(np.zeros(3, np.int64))
        assert (step.next_obs[:, STEP] == 3).all(), "what came before the start is no transition"
        assert step.ended.all()
        obs = step.obs


@pytest.mark.parametrize("name", ENGINES)
def test_waiting_for_a_start_leaves_running_environments_where_they_are(skill_env, name):
    class Moving(Skill):
        def initiation(self, obs):
            return np.abs(obs[:, 1]) > 0.3

        def termination(self, step):
            return step.action == 1

    env = skill_env(name, "CartPole-v1", Moving())
    obs = env.reset(Seeds(0)).copy()
    for t in range(15):
        action = np.eye(3, dtype=np.int64)[t % 3]  # one stops, and looks for a start
        step = env.step(action)
        for before, a, after in zip(obs, action, step.next_obs, strict=True):
            np.testing.assert_allclose(after, cartpole(before, a), atol=1e-5)
        assert step.ended[t % 3]
        assert (np.abs(step.obs[step.ended, 1]) > 0.3).all()
        assert np.array_equal(step.obs[~step.ended], step.next_obs[~step.ended])
        obs = step.obs.copy()


def test_an_initiation_that_never_holds_is_an_error(skill_env):
    class Nowhere(Skill):
        def initiation(self, obs):
            return np.zeros(len(obs), bool)

    with pytest.raises(SkillweaveError, match=r"'nowhere': initiation\(\) held nowhere"):
        skill_env(skill=Nowhere(), num_envs=1).reset(Seeds(0))


def test_a_reflex_overrides_the_action_in_the_environment_and_in_the_skills_eyes(skill_env):
    class Watch(Skill):
        def reward(self, step):
            return step.action

    given = np.zeros(3, np.int64)
    reflex = Reflex(lambda obs: obs[:, STEP] >= 1, 2)
    env = skill_env(skill=Watch(), reflexes=(reflex,))
    obs = env.reset(Seeds(0)).copy()
    for _ in range(12):
        step = env.step(given)
        taken = np.where(obs[:, STEP] >= 1, 2, 0)
        assert np.array_equal(step.next_obs[:, ACTION], taken)
        assert np.array_equal(step.reward, taken)
        obs = step.obs.copy()
    assert not given.any(), "the policy's own array was written to"


def bad_skill(method: str, value) -> Skill:
    """Returns ``value`` from its third step on; the name is 'wrong'."""

    def bad(self, step):
        good = getattr(Skill, method)(self, step)
        return value(good) if step.elapsed.max() >= 3 else good

    return type("Wrong", (Skill,), {method: bad})()


@pytest.mark.parametrize("method", ["reward", "termination", "success"])
@pytest.mark.parametrize("value", [lambda x: x[:1], lambda x: x[:, None], lambda x: 0.0])
def test_a_wrong_shape_names_the_skill_the_method_and_the_step(skill_env, method, value):
    env = skill_env("sync", "CartPole-v1", bad_skill(method, value))
    env.reset(Seeds(0))
    for _ in range(2):
        env.step(np.zeros(3, np.int64))
    with pytest.raises(
        SkillweaveError, match=rf"'wrong': {method}\(\) returned shape .* at step 3"
    ):
        env.step(np.zeros(3, np.int64))


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_a_reward_that_is_not_finite_names_the_skill_and_the_step(skill_env, number):
    env = skill_env("sync", "CartPole-v1", bad_skill("reward", lambda x: x * number))
    env.reset(Seeds(0))
    for _ in range(2):
        env.step(np.zeros(3, np.int64))
    with pytest.raises(SkillweaveError, match=rf"'wrong': reward\(\) returned {number} at step 3"):
        env.step(np.zeros(3, np.int64))


def test_the_step_named_is_that_of_the_environment_named(skill_env):
    class Sour(Skill):
        def termination(self, step):
            return step.action == 1

        def reward(self, step):
            return np.where(step.action == 2, np.nan, 0.0)

    env = skill_env(skill=Sour())
    env.reset(Seeds(0))
    env.step(np.array([0, 1, 0]))  # environment 1 starts anew
    with pytest.raises(SkillweaveError, match="at step 1 for environment 1"):
        env.step(np.array([0, 2, 0]))


def test_a_task_without_a_skill_keeps_its_reward_and_ends(skill_env):
    env = skill_env("sync", "CartPole-v1")
    env.reset(Seeds(0))
    step = env.step(np.zeros(3, np.int64))
    assert step.reward.tolist() == [1.0] * 3
    assert env.mask() is None
    assert "task_reward" not in step.info
