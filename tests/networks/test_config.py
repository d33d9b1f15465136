from dataclasses import replace

from skillweave import PPO, Hierarchy, Skill, TrainDefaults
from skillweave.networks.config import CNN, Network


class Upright(Skill):
    """Stays up."""

    def reward(self, step):
        return 1.0 - abs(step.next_obs[:, 2])


def test_presets_are_what_they_are_called():
    assert CNN() == CNN("plain", (32, 64, 64), (8, 4, 3), (4, 2, 1))
    assert CNN.small() == CNN("plain", (16,), (3,), (1,))
    assert CNN.impala() == CNN("impala", (16, 32, 32), (), ())


def test_a_flat_baseline_sees_the_whole_observation():
    # Else it would not know what the task is, and any hierarchy would win.
    part = Network((8,), sees=(0, 1))
    config = PPO(network=part, critic=replace(part, hidden=(9,)))
    hierarchy = Hierarchy("CartPole-v1", [Upright()], algorithm=config, learn="apart")
    found = hierarchy.plain_agent().algorithm
    assert (found.network, found.critic) == (Network((8,)), Network((9,)))
    assert hierarchy.algorithm is config
    own = PPO(network=part)
    assert hierarchy.plain_agent(own).algorithm is own, "what is asked is done"
    with_defaults = replace(hierarchy, train_defaults=TrainDefaults(flat=own))
    assert with_defaults.plain_agent().algorithm is own
