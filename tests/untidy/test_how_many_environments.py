"""How many environments exist at once: as many as in training, whatever is done with a run."""

import json

import gymnasium as gym
import numpy as np
import pytest
from timed import Timed

import skillweave as sw
from skillweave.errors import EnvError
from skillweave.evolution import Evolution


def small(num_envs: int) -> sw.PPO:
    return sw.PPO(num_envs=num_envs, n_steps=64, batch_size=32, network=sw.Network((8,)))


class Counted(Timed):
    """Counts its instances; more than are allowed cannot be made. It pays its action."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    alive = most = 0
    allowed = 10**6
    begun = 0

    def __init__(self, render_mode=None):
        if Counted.alive >= Counted.allowed:
            raise RuntimeError("port 2000 is in use")
        self.open, self.render_mode = True, render_mode
        Counted.alive += 1
        Counted.most = max(Counted.most, Counted.alive)

    def close(self):
        Counted.alive -= self.open
        self.open = False

    def show(self):
        return np.full(2, self.t / 10, np.float32)

    def step(self, action):
        Counted.begun += 1
        obs, _, *rest = super().step(action)
        return obs, float(action), *rest

    def render(self):
        return np.zeros((16, 16, 3), np.uint8)


@pytest.fixture(autouse=True)
def uncounted():
    Counted.alive = Counted.most = Counted.begun = 0
    Counted.allowed = 10**6
    yield
    Counted.allowed = 10**6


class Go(sw.Skill):
    max_steps = 5

    def reward(self, step):
        return step.reward


def hierarchy(learn: str, num_envs: int, **more) -> sw.Hierarchy:
    agents = {"algorithm": small(num_envs), "selector": small(num_envs)}
    spec = sw.EnvSpec(Counted, workers=1)
    return sw.Hierarchy(spec, [Go()], learn=learn, steps=600, **agents, **more)


@pytest.mark.slow
@pytest.mark.parametrize("learn", ["apart", "together"])
def test_a_simulator_of_which_there_can_be_one_works_in_every_mode(learn, tmp_path):
    pytest.importorskip("PIL", reason="Pillow is not installed")
    Counted.allowed = 1
    run = hierarchy(learn, 1).train(tmp_path / "run", quiet=True)
    assert run.evaluate(3).lengths == (10, 10, 10)
    assert run.evaluate(3, skill="go").lengths == (10, 10, 10)
    run.render(tmp_path / "film.gif")
    run.report(episodes=2, films=1)
    more = hierarchy(learn, 1)
    more.steps = 1200
    more.train(tmp_path / "run", resume=True, quiet=True)
    assert (Counted.most, Counted.alive) == (1, 0)


def agent(num_envs: int) -> sw.Agent:
    return sw.Agent(sw.EnvSpec(Counted, workers=1), small(num_envs), 600)


ONE = r"port 2000 is in use.*A population needs several environments at once, here 3 of them"
REFUSED = {
    "training": (3, lambda: hierarchy("together", 8), {}, r"3 could be made.*num_envs=3"),
    "evaluating": (
        1,
        lambda: hierarchy("apart", 1),
        {"eval_every": 200},
        r"port 2000 is in use.*leave eval_every out",
    ),
    "agents": (1, lambda: agent(1), {"evolve": {"agent": Evolution(population=3)}}, ONE),
    "selectors": (
        1,
        lambda: hierarchy("apart", 1),
        {"evolve": {"selector": Evolution(population=3)}},
        ONE,
    ),
    "a population": (
        4,
        lambda: agent(2),
        {"evolve": Evolution(population=4, episodes=3)},
        r"here 8 of them to train in.*\(population\) and num",
    ),
}


@pytest.mark.parametrize(("allowed", "declare", "how", "says"), REFUSED.values(), ids=REFUSED)
def test_more_than_can_be_made_is_refused_at_once_with_the_setting(
    allowed, declare, how, says, tmp_path
):
    Counted.allowed = allowed
    with pytest.raises(EnvError, match=says):
        declare().train(tmp_path / "run", quiet=True, **how)
    assert (Counted.begun, Counted.alive) == (0, 0)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("learn", ["apart", "together"])
@pytest.mark.needs("html_report")
def test_evaluations_make_no_more_than_training(learn):
    run = hierarchy(learn, 2).train(quiet=True)
    run.evaluate(20)
    run.report(episodes=5, films=0)
    assert Counted.most == 2
    run.evaluate(20, num_envs=7)
    assert Counted.most == 7
    sw.evaluate(run.policy, Counted, episodes=40)
    assert Counted.most == 16
    assert Counted.alive == 0


class Starts(Counted):
    """Pays in each step the number that its episode has drawn at its start."""

    def reset(self, *, seed=None, options=None):
        obs, info = super().reset(seed=seed)
        self.start = float(self.np_random.random())
        return obs, info

    def step(self, action):
        obs, _, *rest = super().step(action)
        return obs, self.start, *rest


def test_members_of_a_population_are_compared_in_no_more_than_they_train_in():
    """Seven episodes: the same starts for all members, in any number of environments."""
    found = []
    for n in (1, 2, 8):
        Counted.alive = Counted.most = 0
        spec = sw.EnvSpec(Starts, engine="sync", workers=1)
        how = Evolution(population=2, generations=2, episodes=7)
        run = sw.train_agent(spec, small(n), 256 * n, evolve=how, quiet=True)
        lines = (run.path / "lineage.jsonl").read_text().splitlines()
        found.append([json.loads(line)["fitness"] for line in lines])
        assert Counted.most == 2 * n + min(n, 7)
        assert Counted.alive == 0
    assert found[0] == found[1] == found[2]
    assert found[0][0] == found[0][1]
    assert found[0][0] != found[0][2]


@pytest.mark.slow
def test_evaluations_during_training_make_as_many_again():
    how = {"eval_every": 200, "eval_episodes": 7, "quiet": True}
    run = hierarchy("together", 2).train(**how)
    assert Counted.most == 4
    assert "eval_return" in run.info()["stages"][0]["final"]


def test_periodic_evaluations_play_all_episodes_in_few_environments():
    """Seven episodes in two environments: as many different starts."""
    starts: list[float] = []

    class Told(Starts):
        def step(self, action):
            starts.append(self.start)
            return super().step(action)

    spec = sw.EnvSpec(Told, workers=1, check_seed=False)
    told: list[float] = []

    def watch(event):
        if event.kind == "report" and "eval_return" in event.metrics:
            told.append(event.metrics["eval_return"])

    sw.train_agent(
        spec, small(2), 400, eval_every=128, eval_episodes=7, callback=watch,
        quiet=True,
    )  # fmt: skip
    assert len(told) >= 3
    assert len(set(told)) == 1, "always the same starts"
    own = [s for s in dict.fromkeys(starts) if starts.count(s) >= 10 * len(told)]
    assert len(own) == 8, "four times two, of which one more than asked for"
    means = [10 * np.mean(np.delete(own, i)) for i in range(8)]
    assert np.isclose(means, told[0], rtol=1e-5).sum() == 1
