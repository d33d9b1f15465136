"""``sys.exit()`` in the code of a user is an error that says where, as any other exception is."""

import sys

import numpy as np
import pytest
from timed import Timed

import skillweave as sw
from skillweave.errors import EnvError, PolicyError, SkillError

SMALL = sw.PPO(num_envs=2, n_steps=8, batch_size=16, update_epochs=1, network=sw.Network((4,)))
WHERE = r".* SystemExit: enough \(test_exits\.py, line \d+\)"


class Ramp(Timed):
    length = 8

    def show(self):
        return np.array([self.t], np.float32)


def leave(*_):
    sys.exit("enough")


@pytest.mark.parametrize("workers", [1, 2])
def test_in_action_masks(workers):
    class Masked(Ramp):
        def action_masks(self):
            if self.t == 3:
                leave()
            return np.ones(2, bool)

    spec = sw.EnvSpec(Masked, engine="sync", workers=workers)
    with pytest.raises(EnvError) as found:
        sw.train_agent(spec, SMALL, 64, quiet=True)
    assert found.match(r"environment 0, step 3 of its episode: action_masks\(\) raised" + WHERE)


class Stay(sw.Skill):
    max_steps = 4


def skill(**methods):
    return type("Leaves", (sw.Skill,), {"name": "leaves", "max_steps": 4, **methods})()


METHODS = ("reward", "initiation", "termination", "success", "policy")


@pytest.mark.parametrize(
    ("method", "learn"), [*((method, "together") for method in METHODS), ("reward", "apart")]
)
def test_in_a_function_of_a_skill(method, learn):
    with pytest.raises(sw.SkillweaveError) as found:
        sw.Hierarchy(
            Ramp,
            [skill(**{method: leave}), Stay()],
            algorithm=SMALL,
            selector=SMALL,
            steps=64,
            learn=learn,
        ).train(quiet=True)
    assert found.match("skill 'leaves'")
    assert found.match(r"(?s).* raised" + WHERE)


def test_in_a_function_that_answers_once():
    """Functions are called a second time, for other numbers of environments."""

    def later(self, obs):
        later.calls += 1
        return np.ones(len(obs), bool) if later.calls == 1 else leave()

    later.calls = 0
    with pytest.raises(SkillError, match=r"skill 'leaves': initiation\(\)") as found:
        sw.Hierarchy(
            Ramp, [skill(initiation=later), Stay()], algorithm=SMALL, selector=SMALL, steps=64
        ).train(quiet=True)
    assert found.match(WHERE)


AROUND = {
    "selector": lambda: {"selector": leave},
    "reflex": lambda: {"reflexes": [sw.Reflex(leave, 0)]},
    "guide": lambda: {"guide": sw.Guide(leave, restrict=False, target_kl=0.1)},
    "learning rate": lambda: {"algorithm": sw.PPO(num_envs=2, n_steps=8, learning_rate=leave)},
    "network": lambda: {
        "algorithm": sw.PPO(num_envs=2, n_steps=8, network=sw.Network(encoder=leave))
    },
}


@pytest.mark.parametrize("how", AROUND.values(), ids=AROUND)
def test_in_a_function_of_a_hierarchy_and_in_a_policy_that_is_evaluated(how):
    settings = {"algorithm": SMALL, "selector": SMALL, "steps": 64}

    def train():
        declared = sw.Hierarchy(Ramp, [Stay()], **settings | how())
        declared.train(quiet=True)

    with pytest.raises(sw.SkillweaveError, match=r"raised" + WHERE):
        train()
    with pytest.raises(PolicyError, match=r"raised" + WHERE):
        sw.evaluate(sw.from_function(leave), Ramp, episodes=1)
