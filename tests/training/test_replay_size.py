"""A replay buffer that cannot be made is refused before there is a run directory."""

from functools import partial

import pytest
from declaring import plainly
from small_runs import Left

from skillweave import DQN, SAC, Apart, Hierarchy, Network, train_agent
from skillweave.errors import SkillweaveError
from skillweave.evolution import Evolution

SMALL = {"num_envs": 4, "batch_size": 8, "learning_starts": 40, "network": Network((4,))}
HUGE = {"buffer_size": 10**9, **SMALL}


FEW = DQN(**SMALL, buffer_size=10)
"""One agent's 4 environments fit into 10 transitions; three agents' 12 do not."""


def hierarchy(path, **how):
    apart = Apart(skill_steps=100, selector_steps=100)
    Hierarchy("CartPole-v1", [Left()], apart=apart, **plainly(how)).train(path, quiet=True)


def agent(path, env, algorithm, **how):
    train_agent(env, algorithm, 100, path, quiet=True, **how)


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize(
    ("train", "says"),
    [
        (partial(hierarchy, algorithm=DQN(**HUGE)), r"stage 'left': .*lower buffer_size"),
        (partial(hierarchy, selector=SAC(**HUGE)), r"stage 'selector': .*lower buffer_size"),
        (
            partial(agent, env="Pendulum-v1", algorithm=SAC(**HUGE)),
            r"stage 'agent': .*lower buffer_size",
        ),
        (
            partial(agent, env="CartPole-v1", algorithm=FEW, evolve=Evolution(3, 2)),
            r"stage 'agent': .*at least num_envs, 12",
        ),
    ],
)
def test_a_buffer_that_cannot_be_made_makes_no_run(tmp_path, train, says):
    with pytest.raises(SkillweaveError, match=says):
        train(tmp_path / "run")
    assert list(tmp_path.iterdir()) == []
