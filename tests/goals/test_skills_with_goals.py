"""One contract: a skill with goals learns by every algorithm, with goals of every kind."""

import functools

import numpy as np
import pytest
from small_runs import goes_on, reports_every
from toys import alone_in
from worlds import OFF, OFTEN, ON, SMALL, SPACES, Point, Rest, declared, go_to

import skillweave as sw
from skillweave._internal.seeding import Seeds
from skillweave.envs.make import EnvSpec, make_engine

often = reports_every(40)
RECURRENT = sw.Network((8,), rnn=sw.algorithms.RNN("gru", 6))
ALGORITHMS = {
    "PPO": (ON, False),
    "PPO, discrete": (ON, True),
    "PPO, recurrent": (
        sw.PPO(
            num_envs=4,
            n_steps=16,
            batch_size=32,
            network=RECURRENT,
        ),
        False,
    ),
    "DQN": (sw.DQN(**OFF, train_freq=2, network=SMALL), True),
    "Rainbow": (sw.DQN.rainbow(**OFF, train_freq=2, network=SMALL), True),
    "SAC": (sw.SAC(**OFF, network=SMALL), False),
    "SAC, discrete": (sw.SAC(**OFF, network=SMALL), True),
    "TD3": (sw.TD3(**OFF, network=SMALL), False),
}


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_learns_with_goals(name, tmp_path):
    algorithm, discrete = ALGORITHMS[name]
    env = functools.partial(Point, discrete=discrete)
    run = declared(env=env, algorithm=algorithm).train(tmp_path / "run", quiet=True)
    alone = run.evaluate(3, skill="go_to")
    assert alone.skills["go_to"].calls == 3
    whole = run.evaluate(3)
    assert whole.skills["go_to"].steps == sum(whole.lengths)
    again = declared(env=env, algorithm=algorithm)
    loaded = again.load_weights(run.save_weights(tmp_path / "weights.safetensors"))
    assert loaded.evaluate(3).returns == whole.returns


@pytest.mark.fast_cases(len(SPACES) + 2)
@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("as_dict", [False, True])
def test_goals_of_every_space(space, as_dict):
    env = functools.partial(Point, as_dict=as_dict)
    hierarchy = declared([go_to(space), Rest()], env=env, selector=rest, steps=130)
    run = hierarchy.train(quiet=True)
    report = run.evaluate(4, skill="go_to")
    assert report.skills["go_to"].calls == 4
    assert run.policy.skills.policies[0].observation_space["goal"] == SPACES[space]


def rest(obs):
    return np.full(len(obs), "rest")


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize(
    ("name", "space"),
    [
        ("SAC", "dict"),
        ("PPO", "whole"),
        ("PPO, recurrent", "box"),
        ("PPO", "box"),
        ("DQN", "box"),
        ("TD3", "box"),
    ],
)
def test_an_interrupted_run_ends_with_the_same_weights(name, space, tmp_path):
    algorithm, discrete = ALGORITHMS[name]

    def hierarchy():
        how = {"env": functools.partial(Point, discrete=discrete), "algorithm": algorithm}
        how |= {"steps": 400, "train_defaults": OFTEN}
        if discrete:  # what rests has actions of a Box
            return declared([go_to(space)], **how)
        return declared([go_to(space), Rest()], selector=rest, **how)

    goes_on(hierarchy, tmp_path)


def test_goals_of_another_shape_than_a_checkpoints_are_refused():
    acting = None
    collector = alone_in(make_engine(EnvSpec(Point, engine="sync"), 2), acting, go_to())
    collector.start(Seeds(0))
    state = collector.state()
    state["kept.goal"] = state["kept.goal"][:, :1]
    with pytest.raises(sw.SkillweaveError, match=r"'goal' of open episodes .* have changed"):
        collector.restore(state)


def test_goals_where_other_calls_come_first():
    class Late(sw.Skill):
        max_steps = 5

        def initiation(self, obs):
            return obs[:, 0] > 0.5

        def reward(self, step):
            return step.next_obs[:, 0]

    late = type("GoBack", (type(go_to()),), {"initiation": lambda self, obs: obs[:, 0] < -0.3})()
    apart = sw.Apart(start_calls=2, episode_calls=3)
    hierarchy = declared([go_to(), Late(), late], selector=rest_or_go, steps=600, apart=apart)
    run = hierarchy.train(quiet=True)
    assert run.evaluate(3, skill="go_back").skills["go_back"].steps > 0


def rest_or_go(obs):
    return np.full(len(obs), "go_to"), {"go_to": np.zeros((len(obs), 2)), "go_back": obs / 4}


def test_a_skill_with_goals_beside_one_without_learns_together():
    class Right(sw.Skill):
        max_steps = 4

        def reward(self, step):
            return step.next_obs[:, 0]

    selector = sw.PPO(num_envs=4, n_steps=64, batch_size=16, network=SMALL)
    hierarchy = declared([Right(), go_to()], selector=selector, learn="together", steps=600)
    run = hierarchy.train(quiet=True)
    assert run.evaluate(3, skill="go_to").skills["go_to"].calls == 3


@pytest.mark.slow
def test_goals_in_processes():
    spec = EnvSpec(Point, engine="sync", workers=2)
    run = declared(env=spec).train(quiet=True)
    assert run.evaluate(2, skill="go_to").skills["go_to"].calls == 2
