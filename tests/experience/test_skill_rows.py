"""Rows of a skill equal a scalar loop in each environment, with whatever engine."""

import itertools

import numpy as np
import pytest
from reference_calls import POSITION, T, Walk, seeds_of, shy
from scalar_skill import ScalarSkill
from toy_acting import Again, Choices, Counts, Given, requests, step
from toys import Ledger, actions, alone_in, cartpole

from skillweave._internal.seeding import Seeds
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import SkillweaveError
from skillweave.experience import search
from skillweave.skills import Reflex, Skill

pytestmark = pytest.mark.filterwarnings("ignore:.*precision lowered")
ENGINES = ["envpool", "sync"]
TAG, EPISODE, STEP, ACTION = range(4)  # of Ledger
SEED = (Seeds(0) / "env").integer()  # of the environments


@pytest.fixture
def collector():
    """Makes collectors that have started, and closes them in the end."""
    made = []

    def make(name="sync", env=Ledger, skill=None, num_envs=3, reflexes=(), acting=Given, seed=0):
        if name == "envpool":
            pytest.importorskip("envpool")
        engine = make_engine(EnvSpec(env, engine=name), num_envs, threads=1)
        made.append(alone_in(engine, acting(num_envs), skill, reflexes))
        made[-1].start(Seeds(seed))
        return made[-1]

    yield make
    for each in made:
        each.close()


# Equal to a scalar loop ----------------------------------------------------------------------


class Fleeting(Skill):
    """Ends where it is far to the right, sometimes in the very step that ``max_steps`` ends it."""

    max_steps = 4

    def reward(self, step):
        return step.next_obs[:, POSITION] - 0.5 * step.elapsed + 8 * step.timed_out + step.reward

    def termination(self, step):
        return step.next_obs[:, POSITION] >= 2

    def success(self, step):
        return step.next_obs[:, POSITION] + step.action >= 3


class Elsewhere(Fleeting):
    """May start to the left only, where no episode begins."""

    def initiation(self, obs):
        return obs[:, POSITION] <= -1


class Timed(Skill):
    """Has only a time limit."""

    max_steps = 5


class Acting(Choices):
    """Chooses among three actions."""

    def __init__(self, num_envs):
        super().__init__(num_envs, 3)


@pytest.mark.fast_cases(5)
@pytest.mark.parametrize("reflexes", [(), (shy(), Reflex(lambda obs: obs[:, T] == 3, 0))])
@pytest.mark.parametrize("skill", [None, Skill(), Timed(), Fleeting(), Elsewhere()])
@pytest.mark.parametrize("rows", [1, 7, 60])
def test_every_row_is_that_of_a_scalar_loop(collector, skill, rows, reflexes):
    n, walks = 4, []

    def walk():
        walks.append(Walk())
        return walks[-1]

    env = collector(env=walk, skill=skill, num_envs=n, reflexes=reflexes, acting=Acting)
    walks = walks[-n:]
    scalars = [ScalarSkill(Walk(), skill, s, reflexes) for s in seeds_of(SEED, n)]
    seen = {"terminated": 0, "truncated": 0, "searching": 0, "episodes": 0}
    for request in itertools.islice(requests(rows), -(-180 // rows)):
        collected = env.collect(request)
        experience, told = collected.batches[""], []
        assert collected.steps == rows * n, "a step is not counted"
        assert (experience["steps"] == 1).all()
        for t, i in itertools.product(range(rows), range(n)):
            scalar, before = scalars[i], len(scalars[i].episodes)
            done = walks[i].log[scalar.env.steps][-1]  # in the environment itself
            if not scalar.searching:
                assert done == scalar.overridden(int(experience["action"][t, i]))
            want = scalar.row(done)
            np.testing.assert_array_equal(experience["next_obs"][t, i], want.next_obs)
            np.testing.assert_array_equal(experience["obs"][t, i], want.obs)
            assert (
                experience.get("valid") is None or bool(experience["valid"][t, i])
            ) == want.valid
            assert experience["terminated"][t, i] == want.terminated
            assert experience["truncated"][t, i] == want.truncated
            if want.valid:
                assert experience["reward"][t, i] == np.float32(want.reward)
            told += scalar.episodes[before:]
            seen["terminated"] += want.terminated
            seen["truncated"] += want.truncated
            seen["searching"] += not want.valid
        np.testing.assert_allclose(collected.episodes, np.reshape(told, (-1, 4)), rtol=1e-6)
        seen["episodes"] += len(told)
    assert seen.pop("searching") > 0 or not isinstance(skill, Elsewhere)
    assert min(seen.values()) > 7


@pytest.mark.parametrize("skill", [None, Timed(), Elsewhere()])
@pytest.mark.parametrize("rows", [1, 7])
def test_memory_is_empty_where_an_episode_begins_and_starts_say_so(collector, skill, rows):
    env = collector(env=Walk, skill=skill, num_envs=4, acting=lambda n: Counts(n, 3))
    scalars = [ScalarSkill(Walk(), skill, s) for s in seeds_of(SEED, 4)]
    begun, remembered = 0, np.zeros(4)
    walks = [e.unwrapped for e in env.engine.envs]
    for request in itertools.islice(requests(rows), 140 // rows):
        experience = env.collect(request).batches[""]
        first = [True] * 4
        for t, i in itertools.product(range(rows), range(4)):
            want = scalars[i].row(walks[i].log[scalars[i].env.steps][-1])
            if not want.valid:
                continue
            assert experience["episode_start"][t, i] == want.starts
            remembered[i] = 0 if want.starts else remembered[i]
            assert experience["dist_params"][t, i, 0] == remembered[i]
            if first[i] and not want.starts:
                assert experience["recurrent_state"][i, 0] == remembered[i]
            first[i], begun = False, begun + want.starts
            remembered[i] += 1
    assert begun > 10


# With any engine -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ENGINES)
def test_no_step_is_ignored_and_none_invented(collector, name):
    env = collector(name, "CartPole-v1")
    obs, ends = env.obs.copy(), 0
    for t in range(60):
        action = actions(3, 0) if t % 3 else actions(3, 1)
        row = step(env, action).batches[""]
        for before, a, after in zip(obs, action, row["next_obs"][0], strict=True):
            np.testing.assert_allclose(after, cartpole(before, a), atol=1e-5)
        ended = row.ended[0]
        assert np.array_equal(env.obs[~ended], row["next_obs"][0][~ended])
        assert (np.abs(env.obs[ended]) <= 0.05).all(), "not reset"
        assert (row["reward"] == 1.0).all()
        ends += ended.sum()
        obs = env.obs.copy()
    assert ends > 3


@pytest.mark.parametrize("name", ENGINES)
def test_the_same_seeds_give_the_same_rows_and_others_do_not(collector, name):
    class Late(Skill):
        def initiation(self, obs):
            return np.abs(obs[:, 3]) > 0.2  # so that random actions are taken first

    def play(seed):
        env = collector(name, "CartPole-v1", Late(), acting=lambda n: Choices(n, 2), seed=seed)
        seen = [env.collect(r).batches[""] for r in itertools.islice(requests(9), 3)]
        assert not seen[0]["valid"].all()
        return np.concatenate([e["obs"] for e in seen])

    first = play(1)
    assert np.array_equal(play(1), first)
    assert not np.array_equal(play(2)[0], first[0])


@pytest.mark.parametrize("name", ENGINES)
def test_max_steps_truncates_and_really_resets(collector, name):
    class Short(Skill):
        max_steps = 3

    env = collector(name, "CartPole-v1", Short())
    for t in range(1, 10):
        before = env.obs.copy()
        row = step(env, np.ones(3, np.int64)).batches[""]
        for was, after in zip(before, row["next_obs"][0], strict=True):
            np.testing.assert_allclose(after, cartpole(was, 1), atol=1e-5)
        assert not row["terminated"].any()
        assert row["truncated"][0].tolist() == [t % 3 == 0] * 3
        if t % 3 == 0:
            assert (row["next_obs"][0, :, 1] > 0.4).all(), "not the true successor"
            assert (np.abs(env.obs) <= 0.05).all(), "not reset"


@pytest.mark.parametrize("name", ENGINES)
def test_environments_that_search_act_at_random_while_the_others_go_on(collector, name):
    class Moving(Skill):
        def initiation(self, obs):
            return np.abs(obs[:, 1]) > 0.3

        def termination(self, step):
            return step.action == 1

    env = collector(name, "CartPole-v1", Moving())
    waited, acted, sides = 0, 0, set()
    for t in range(60):
        before, elapsed = env.obs.copy(), env.kept["elapsed"].copy()
        action = np.eye(3, dtype=np.int64)[t % 3]  # one of them stops
        collected = step(env, action)
        row = collected.batches[""]
        assert collected.steps == 3
        valid = row.valid_rows[0]
        waited, acted = waited + int((~valid).sum()), acted + int(valid.sum())
        for i in range(3):
            ways = [cartpole(before[i], a) for a in (0, 1)]
            found = [np.allclose(row["next_obs"][0, i], way, atol=1e-5) for way in ways]
            if valid[i]:
                assert np.abs(before[i, 1]) > 0.3 or elapsed[i]
                assert found[action[i]]
                assert row["terminated"][0, i] == (action[i] == 1)
            else:
                assert any(found)
                sides.add(found.index(True))
                assert not row.ended[0, i]
    assert waited > 10
    assert acted > 10
    assert sides == {0, 1}


# What the skill sees -------------------------------------------------------------------------


@pytest.mark.usefixtures("no_trials")
@pytest.mark.usefixtures("unprobed")
def test_a_skill_sees_the_whole_step_and_its_reward_replaces_the_tasks(collector):
    seen = []

    class Watch(Skill):
        max_steps = 2

        def reward(self, step):
            seen.append(step)
            return step.next_obs[:, STEP] - 0.5 * step.elapsed

        def success(self, step):
            return step.action == 2

    env = collector(skill=Watch(), num_envs=2)
    for t in range(4):
        before, action = env.obs.copy(), np.array([t % 3, 2])
        collected = step(env, action)
        row, (told,) = collected.batches[""], seen[t:]
        assert np.array_equal(told.obs, before)
        assert np.array_equal(told.action, action)
        assert np.array_equal(told.next_obs, row["next_obs"][0])
        assert told.reward.tolist() == [10 * (t % 2 + 1) + t % 3, 10 * (t % 2 + 1) + 2]
        assert told.timed_out.tolist() == [t % 2 == 1 and not told.terminated[0]] * 2
        assert told.info["t"].tolist() == [t % 2 + 1] * 2
        assert row["reward"][0].tolist() == [0.5 * (t % 2 + 1)] * 2
        assert row["reward"].dtype == np.float32
        if t % 2:  # return, the task's, length, success
            paid = 10 + (t - 1) % 3 + 20 + t % 3
            wanted = [[1.5, paid, 2.0, t % 3 == 2], [1.5, 34.0, 2.0, 1.0]]
            assert collected.episodes.tolist() == wanted
        else:
            assert not len(collected.episodes)


def test_a_reflex_overrides_the_action_in_the_environment_and_in_the_skills_eyes(collector):
    class Watch(Skill):
        def reward(self, step):
            return step.action

    given = np.zeros(3, np.int64)
    env = collector(skill=Watch(), reflexes=(Reflex(lambda obs: obs[:, STEP] >= 1, 2),))
    for _ in range(12):
        before = env.obs.copy()
        row = step(env, given).batches[""]
        taken = np.where(before[:, STEP] >= 1, 2, 0)
        assert np.array_equal(row["next_obs"][0, :, ACTION], taken)
        assert np.array_equal(row["reward"][0], taken)
        assert row["action"][0].tolist() == [0] * 3, "what the learner chose is what it learns of"
    assert not given.any(), "the policy's own array was written to"


# Where a skill may start ---------------------------------------------------------------------


class Nowhere(Skill):
    """May start in one environment at most, which a test names."""

    only: float | None = None

    def initiation(self, obs):
        return obs[:, TAG] == self.only


def test_an_initiation_that_never_holds_is_an_error(collector, monkeypatch):
    monkeypatch.setattr(search, "PATIENCE", 50)
    env = collector(skill=Nowhere(), num_envs=2)
    for _ in range(49):  # many episodes: it counts on from one to the next
        step(env, np.zeros(2, np.int64))
    with pytest.raises(
        SkillweaveError, match=r"'nowhere': initiation\(\) was never true in 50 ste"
    ):
        step(env, np.zeros(2, np.int64))


def test_an_environment_in_which_an_episode_cannot_begin_is_given_up_when_one_is_played(
    collector, monkeypatch
):
    monkeypatch.setattr(search, "PATIENCE", 50)

    class Here(Nowhere):
        """May start in the first environment, and lasts 3 steps."""

        max_steps = 3

    env = collector(skill=Here(), num_envs=2, acting=Acting)
    env.begun = False
    env.start(Seeds(0))
    Here.only, before = env.obs[0, TAG], env.engine.steps_made
    first, second = env.play(next(requests(1)), Seeds(0), 10_000)
    assert first[2] == 3
    assert np.isnan(second).all()
    assert env.engine.steps_made - before <= 2 * 60


def test_an_initiation_that_holds_somewhere_is_searched_for_ever_after_a_resume_too(
    collector, monkeypatch
):
    monkeypatch.setattr(search, "PATIENCE", 50)

    def fresh():
        return collector(env=Again, skill=Once(), num_envs=2)

    Once.open = True
    env = fresh()
    Once.open = False
    assert step(env, np.zeros(2, np.int64)).batches[""].get("valid") is None
    for _ in range(70):
        step(env, np.zeros(2, np.int64))
    again = fresh()
    assert not len(again.restore(env.state()))
    for _ in range(70):
        step(again, np.zeros(2, np.int64))


class Once(Skill):
    """May start while a test says so."""

    open = False

    def initiation(self, obs):
        return np.full(len(obs), type(self).open)


# What is wrong -------------------------------------------------------------------------------


def bad_skill(method: str, value) -> Skill:
    """Returns ``value`` from its third step on; the name is 'wrong'."""

    def bad(self, step):
        good = getattr(Skill, method)(self, step)
        return value(good) if step.elapsed.max() >= 3 else good

    return type("Wrong", (Skill,), {method: bad})()


@pytest.mark.parametrize("method", ["reward", "termination", "success"])
def test_a_wrong_shape_names_the_skill_the_method_and_the_step(collector, method):
    env = collector("sync", "CartPole-v1", bad_skill(method, lambda x: x[:, None]))
    for _ in range(2):
        step(env, np.zeros(3, np.int64))
    with pytest.raises(
        SkillweaveError, match=rf"'wrong': {method}\(\) returned shape .* at step 3"
    ):
        step(env, np.zeros(3, np.int64))


class Sour(Skill):
    def termination(self, step):
        return step.action == 1

    def reward(self, step):
        return np.where(step.action == 2, np.nan, 0.0)


class SourLater(Sour):
    """May not start in the environment that has a tag."""

    shut = None

    def initiation(self, obs):
        return obs[:, TAG] != SourLater.shut


def test_the_step_and_environment_named_are_the_right_ones_also_where_others_search(
    collector, monkeypatch
):
    env = collector(skill=Sour())
    step(env, np.array([0, 1, 0]))  # environment 1 starts anew
    with pytest.raises(SkillweaveError, match="at step 1 for environment 1"):
        step(env, np.array([0, 2, 0]))
    monkeypatch.setattr(SourLater, "shut", collector().obs[0, TAG])
    env = collector(skill=SourLater())
    assert step(env, np.array([0, 1, 0])).batches[""]["valid"].tolist() == [[False, True, True]]
    with pytest.raises(SkillweaveError, match="at step 1 for environment 1"):
        step(env, np.array([0, 2, 0]))


def test_the_environment_whose_initiation_is_no_flag_is_the_right_one(collector):
    class Half(Skill):
        def initiation(self, obs):
            return np.where((obs[:, EPISODE] == 1), 0.5, 1.0)

        def termination(self, step):
            return step.action == 1

    env = collector(skill=Half())
    with pytest.raises(SkillweaveError, match=r"initiation\(\) returned 0.5 for environment 1"):
        step(env, np.array([0, 1, 0]))
