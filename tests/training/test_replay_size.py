"""A replay buffer that cannot be made is refused before there is a run directory."""

import pytest
from declaring import plainly
from small_runs import Left

from skillweave import DQN, SAC, Apart, Hierarchy, Network, train_agent
from skillweave.errors import SkillweaveError, TrainingError
from skillweave.evolution import Evolution

SMALL = {"num_envs": 4, "batch_size": 8, "learning_starts": 40, "network": Network((4,))}
HUGE = {"buffer_size": 10**9, **SMALL}


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize(
    ("how", "says"),
    [
        ({"algorithm": DQN(**HUGE)}, r"stage 'left': .*lower buffer_size"),
        ({"selector": SAC(**HUGE)}, r"stage 'selector': .*lower buffer_size"),
    ],
)
def test_a_hierarchy_whose_buffer_is_larger_than_the_memory_makes_no_run(tmp_path, how, says):
    hierarchy = Hierarchy(
        "CartPole-v1", [Left()], apart=Apart(skill_steps=100, selector_steps=100), **plainly(how)
    )
    with pytest.raises(SkillweaveError, match=says):
        hierarchy.train(tmp_path / "run", quiet=True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("env", ["CartPole-v1", "Pendulum-v1"])
def test_an_agent_whose_buffer_is_larger_than_the_memory_makes_no_run(tmp_path, env):
    with pytest.raises(TrainingError, match=r"stage 'agent': .*lower buffer_size"):
        train_agent(env, SAC(**HUGE), 100, tmp_path / "run", quiet=True)
    assert list(tmp_path.iterdir()) == []


def test_a_population_whose_members_share_too_small_a_buffer_makes_no_run(tmp_path):
    # One agent's 4 environments fit into 10 transitions; three agents' 12 do not.
    config, evolve = DQN(**SMALL, buffer_size=10), Evolution(population=3, generations=2)
    with pytest.raises(SkillweaveError, match=r"stage 'agent': .*at least num_envs, 12"):
        train_agent("CartPole-v1", config, 100, tmp_path / "run", quiet=True, evolve=evolve)
    assert list(tmp_path.iterdir()) == []
