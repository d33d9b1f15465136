"""Every step that an environment makes in training is reported, and none twice."""

import gymnasium as gym
import numpy as np
import pytest
from declaring import plainly

import skillweave as sw
from skillweave.evolution import Evolution
from skillweave.runs.directory import RunDirectory

NET = sw.Network((8,))
SMALL = sw.PPO(num_envs=4, n_steps=16, batch_size=32, update_epochs=1, network=NET)
REPLAY = {"num_envs": 4, "learning_starts": 40, "batch_size": 8, "update_ratio": 0.1}


class Walk(gym.Env):
    """Episodes of 20 steps; the observation is the time."""

    observation_space = gym.spaces.Box(0.0, 1.0, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        return np.array([self.t / 20], np.float32), float(action), self.t == 20, False, {}


class Late(sw.Skill):
    """May start late in an episode, which random acting has to find."""

    def initiation(self, obs):
        return obs[:, 0] >= 0.7


class Always(sw.Skill):
    """May start anywhere."""


def reported(run: sw.Run) -> int:
    stages = run.info()["stages"]
    return sum(p["steps"] + p["evaluation_steps"] for p in stages)


def hierarchy(**settings) -> sw.Hierarchy:
    given = {"algorithm": SMALL, "selector": SMALL, "skill_steps": 600, "selector_steps": 600}
    spec = sw.EnvSpec(Walk, engine="sync")
    return sw.Hierarchy(spec, [Late(), Always()], call_steps=3, **plainly({**given, **settings}))


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"eval_every": 200, "eval_episodes": 3},
        {"algorithm": sw.DQN(**REPLAY, network=NET), "selector": sw.DQN(**REPLAY, network=NET)},
    ],
)
def test_the_search_for_a_start_is_reported_and_counts_against_the_budget(settings, made, tmp_path):
    run = hierarchy(**settings).train(tmp_path / "run", quiet=True)
    assert reported(run) == made[0]
    late, always, selector = run.info()["stages"]
    rollout = 4 * 16 if "algorithm" not in settings else 4 * 3  # of a selector, call_steps
    for stage in (late, always, selector):
        assert 600 <= stage["steps"] < 600 + rollout, stage["name"]
    assert (always["evaluation_steps"] > 0) == ("eval_every" in settings)


@pytest.mark.parametrize("algorithm", [SMALL, sw.DQN(**REPLAY, network=NET)])
def test_the_fitness_of_a_population_is_reported_and_counts_against_the_budget(
    algorithm, made, tmp_path
):
    search = Evolution(population=3, generations=4, episodes=5)
    spec = sw.EnvSpec(Walk, engine="sync")
    run = sw.train_agent(spec, algorithm, 800, tmp_path / "run", quiet=True, evolve=search)
    assert reported(run) == made[0]
    (entry,) = run.info()["stages"]
    assert entry["budget"] == 2400
    # The first generation could not know what fitness takes: 3 members and the best, 5 episodes.
    assert 2000 <= entry["steps"] <= 2400 + 3 * 64 + 4 * 100


@pytest.mark.slow
def test_what_a_killed_and_resumed_run_made_again_is_not_reported_twice(made, tmp_path):
    class Stop(Exception):
        pass

    class Stopping(sw.api.running.Progress):
        def tick(self, name, steps, seconds, metrics):
            if name == "always" and steps >= 400:
                raise Stop

    whole = hierarchy(checkpoint_every=150).train(tmp_path / "whole", quiet=True)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("skillweave.api.running.Progress", Stopping)
        with pytest.raises(Stop):
            hierarchy(checkpoint_every=150).train(tmp_path / "broken", quiet=True)
    again = hierarchy(checkpoint_every=150).resume(tmp_path / "broken", quiet=True)
    ours, theirs = ([p["steps"] for p in r.info()["stages"]] for r in (again, whole))
    assert ours == theirs


@pytest.mark.slow
def test_the_default_selector_makes_hundreds_of_updates(tmp_path):
    class Zero(sw.Skill):
        def policy(self, obs):
            return np.zeros(len(obs), np.int64)

    class One(sw.Skill):
        def policy(self, obs):
            return np.ones(len(obs), np.int64)

    # No skill learns, so all steps are the selector's.
    declared = sw.Hierarchy(sw.EnvSpec(Walk, engine="sync"), [Zero(), One()], steps=50_000)
    run = declared.train(tmp_path / "run", quiet=True)
    updates = sum(1 for _ in RunDirectory.open(run.path).metrics())
    assert updates >= 150 / 20
    assert run.info()["stages"][0]["steps"] < declared.total_steps + 64 * 64


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("algorithm", [SMALL, sw.DQN(**REPLAY, network=NET)])
@pytest.mark.parametrize("evolve", [None, Evolution(population=2, generations=10, episodes=1)])
def test_episodes_longer_than_what_lies_between_cuts_or_generations_are_learnt_to_their_ends(
    algorithm, evolve, tmp_path
):
    # Episodes of 20 steps; cuts every 5 to 16 steps of an environment, generations as short.
    spec, task = sw.EnvSpec(Walk, engine="sync"), Always()
    declared = sw.Hierarchy(
        spec,
        [task],
        algorithm=algorithm,
        train_defaults=sw.TrainDefaults(checkpoint_every=20),
        steps=640,
    )
    run = declared.train(tmp_path / "run", flat=True, quiet=True, evolve=evolve)
    lines = list(RunDirectory.open(run.path).metrics())
    ended = [line for line in lines if "length" in line]
    assert len(ended) > len(lines) / 2
    assert {line["length"] for line in ended} == {20.0}


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("algorithm", [SMALL, sw.DQN(**REPLAY, network=NET)])
def test_a_population_reports_its_search_for_a_start(algorithm, made, tmp_path):
    declared = hierarchy(algorithm=algorithm, selector_steps=300)
    search = {"late": Evolution(population=2, generations=3, episodes=2)}
    run = declared.train(tmp_path / "run", quiet=True, evolve=search)
    assert reported(run) == made[0]


def test_a_population_whose_budget_ends_it_early_says_so(tmp_path, capsys):
    search = Evolution(population=2, generations=5, episodes=20)
    spec = sw.EnvSpec(Walk, engine="sync")
    run = sw.train_agent(spec, SMALL, 300, tmp_path / "run", evolve=search)
    assert run.info()["stages"][0]["winner"]["generations"] < 5
    assert "of 5 generations: measuring fitness counts, too" in capsys.readouterr().err
