from dataclasses import replace

import pytest

from skillweave import PPO, Hierarchy, Skill, TrainDefaults
from skillweave.errors import SkillweaveError
from skillweave.networks.config import CNN, RNN, Network


class Upright(Skill):
    """Stays up."""

    def reward(self, step):
        return 1.0 - abs(step.next_obs[:, 2])


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Network(hidden=(64, 0)), r"Network\.hidden\[1\] is 0; .*at least 1"),
        (lambda: Network(hidden=64), r"Network\.hidden is 64; it must be a list, .*at least 1"),
        (
            lambda: Network(hidden=(8.0,)),
            r"Network\.hidden\[0\] is 8\.0.*a whole number",
        ),
        (lambda: Network(activation="sine"), r"Network\.activation is 'sine'.*tanh, relu, elu"),
        (lambda: Network(cnn="impala"), r"Network\.cnn is 'impala'.*it must be CNN\(\) or None"),
        (lambda: Network(rnn="lstm"), r"Network\.rnn is 'lstm'.*it must be RNN\(\) or None"),
        (lambda: Network(sees=8), r"Network\.sees is 8; it must be a tuple of places"),
        (lambda: Network(sees=()), r"Network\.sees is \(\); it must be a tuple of places"),
        (lambda: Network(sees=(0, -1)), r"Network\.sees\[1\] is -1; it must be at least 0"),
        (lambda: Network(sees=(0, 2, 0)), r"Network\.sees is \(0, 2, 0\).*each once"),
        (lambda: Network(sees=(True,)), r"Network\.sees\[0\] is True; it must be a whole number"),
        (lambda: Network(sees=(0,), encoder="cells"), r"Network: give sees or encoder, not both"),
        (lambda: CNN(kind="resnet"), r"CNN\.kind is 'resnet'.*one of plain, impala"),
        (lambda: CNN("plain", (), (), ()), r"CNN\.channels is \(\).*at least one layer"),
        (lambda: CNN.impala(()), r"CNN\.channels is \(\).*at least one layer"),
        (lambda: CNN(channels=(8, 0, 8)), r"CNN\.channels\[1\] is 0; .*at least 1"),
        (lambda: CNN(kernels=(8, 4, -3)), r"CNN\.kernels\[2\] is -3; .*at least 1"),
        (lambda: CNN(strides=(4, 2, 0)), r"CNN\.strides\[2\] is 0; .*at least 1"),
        (lambda: CNN(strides=(4, 2)), r"CNN\.channels, kernels and strides have 3, 3 and 2"),
        (lambda: RNN(kind="elman"), r"RNN\.kind is 'elman'.*one of lstm, gru"),
        (lambda: RNN(size=0), r"RNN\.size is 0; it must be at least 1"),
        (lambda: RNN(size=2.5), r"RNN\.size is 2\.5; it must be a whole number, at least 1"),
    ],
)
def test_an_architecture_that_cannot_be_is_named_with_what_it_must_be(make, says):
    with pytest.raises(SkillweaveError, match=says):
        make()


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
