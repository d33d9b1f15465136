"""A population of selectors in which one diverges while its calls are open."""

import numpy as np
import pytest
from small_runs import interrupt_at_checkpoint

from skillweave import PPO, Apart, EnvSpec, Hierarchy, Network, Skill
from skillweave.evolution import Evolution
from skillweave.evolution.shard import Shard
from skillweave.runs.files import read_tensors


class Go(Skill):
    """Pushes to the right."""

    def policy(self, obs):
        return np.ones(len(obs), np.int64)


class Stay(Skill):
    """Pushes to the left."""

    def policy(self, obs):
        return np.zeros(len(obs), np.int64)


def declare():
    ppo = PPO(num_envs=4, n_steps=16, batch_size=32, update_epochs=1, network=Network((8,)))
    env = EnvSpec("CartPole-v1", engine="sync", workers=1)
    return Hierarchy(
        env,
        [Go(), Stay()],
        call_steps=9,
        selector=ppo,
        apart=Apart(selector_steps=1200),
        learn="apart",
    )


@pytest.mark.slow
@pytest.mark.parametrize("checkpoint", [1, 2])
def test_who_takes_its_place_goes_on_with_calls_that_it_can_learn_from(
    checkpoint, tmp_path, monkeypatch
):
    path, joined, poisoned = tmp_path / "run", Shard._stack, []

    def poison(self, group):
        stack = joined(self, group)
        if not poisoned:
            stack.state.params[1] = float("nan")
            poisoned.append(1)
        return stack

    evolve = Evolution(population=3, generations=3, episodes=2)
    with monkeypatch.context() as patched:
        patched.setattr(Shard, "_stack", poison)
        interrupt_at_checkpoint(patched, checkpoint)
        with pytest.raises(KeyboardInterrupt):
            declare().train(path, seed=3, quiet=True, evolve=evolve)
    heads = {k: v for k, v in read_tensors(path / "checkpoint.safetensors")[0].items()
             if k.endswith("open.dist_params")}  # fmt: skip
    assert len(heads) == 3
    assert all(bool(v.isfinite().all()) for v in heads.values())
    stages = declare().resume(path, quiet=True).info()["stages"]
    assert [stage["status"] for stage in stages] == ["done"]
