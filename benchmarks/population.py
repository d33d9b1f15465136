"""Costs of a population, and a check that its members learn as they would alone.

    python -m benchmarks.population [--seeds 0 1 2] [--agilerl PYTHON]

1. Steps/s of 8 members together against one agent with as many environments and as many samples in
   a gradient step.
2. The same against AgileRL's population of 8 by its own training function, in an interpreter that
   has it (``pip install agilerl peft "gymnasium[box2d]"``): it asks for other versions than ours.
3. One update of 16 members against the same one by one.
5. The largest change of any output when networks grow.
6. The largest difference of any weight between 8 members of three widths in one stack, and the
   same members alone, after 10 updates.

The numbers are those of the figures in the issue; 4 is ``benchmarks.search``.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.common import median, report, run_command, table, warm_up
from benchmarks.updates import rollout, seconds
from skillweave import PPO, EnvSpec, Network
from skillweave._internal.seeding import Seeds
from skillweave.evolution import Evolution
from skillweave.evolution.architecture import Change, rebuilt
from skillweave.evolution.population import Population
from skillweave.evolution.stacks import Member, join, split
from skillweave.training.learning_task import skill_task
from skillweave.training.role import agent_role

LANDER = EnvSpec("LunarLander-v3")
SPACES = LANDER.make().observation_space, LANDER.make().action_space
MEMBERS, ENVS = 8, 16
AGILERL = Path(__file__).with_name("agilerl_population.py")


def speed(members: int, config: PPO, steps: int, seed: int) -> float:
    """Return steps/s of a population's training, all members' steps counted."""
    population = Population.fresh(config, Evolution(), skill_task(agent_role(LANDER)), Seeds(seed))
    population.members = population.members[:members]
    started = time.perf_counter()
    population.train(steps // members, steps // members, Seeds(seed), lambda steps, metrics: None)
    return population.steps / (time.perf_counter() - started)


def together_and_alone(seeds: list[int], steps: int) -> tuple[list[list[Any]], float]:
    """Figure 1: rows, and the median ratio."""
    each = PPO(num_envs=ENVS, n_steps=64, batch_size=128, update_epochs=4)
    whole = replace(each, num_envs=ENVS * MEMBERS, batch_size=128 * MEMBERS)
    rows = []
    for seed in seeds:
        one, many = speed(1, whole, steps, seed), speed(MEMBERS, each, steps, seed)
        rows.append([seed, round(one), round(many), round(many / one, 3)])
    return rows, median(r[3] for r in rows)


def against_agilerl(seeds: list[int], steps: int, python: str) -> dict[str, Any]:
    """Figure 2, with AgileRL's default settings for both; theirs and ours by turns."""
    ours, theirs = [], []
    config = PPO(num_envs=ENVS, n_steps=4096 // ENVS, batch_size=64, update_epochs=4)
    for seed in seeds:
        theirs.append(_agilerl(python, steps // 4))
        ours.append(speed(MEMBERS, config, steps, seed))
    ratio = median(a / b for a, b in zip(ours, theirs, strict=True))
    return {
        "2: ours / AgileRL": round(ratio, 2),
        "ours": round(median(ours)),
        "AgileRL": round(median(theirs)),
    }


def _agilerl(python: str, steps: int) -> float:
    done = run_command([python, str(AGILERL), str(steps)], capture=True, check=False)
    if done.returncode:
        raise SystemExit(f"AgileRL failed:\n{done.stderr[-2000:]}")
    return float(done.stdout.split()[-1])


def growth() -> float:
    """Figure 5: the largest change of an output, over activations, changes and seeds."""
    worst = 0.0
    for activation in ("tanh", "relu", "elu", "silu", "gelu"):
        changes = [Change("units", 0, 32), Change("units", 1, 32)]
        changes += [Change("layer", by=1)] * (activation != "tanh")
        for change in changes:
            for seed in range(5):
                member = Member(0, PPO(network=Network((64, 64), activation)), None)
                member.state = member.algorithm(SPACES).init([Seeds(seed)])
                generator = torch.Generator().manual_seed(seed)
                drawn = torch.randn(member.state.params.shape, generator=generator)
                member.state.params.add_(0.1 * drawn)  # a critic begins at 0
                after = rebuilt(member, change, SPACES, np.random.default_rng(seed))
                worst = max(worst, float((_outputs(member) - _outputs(after)).abs().max()))
    return worst


def _outputs(member: Member) -> torch.Tensor:
    algorithm: Any = member.algorithm(SPACES)
    generator = torch.Generator().manual_seed(0)
    inputs = {"vector": torch.randn(1, 1000, 8, generator=generator)}
    views = algorithm.layout.views(member.state.params)
    nets = algorithm.actor_net, algorithm.critic_net
    return torch.cat([net(views, inputs) for net in nets], dim=-1)


def padded() -> float:
    """Figure 6: the largest difference of a weight after 10 updates."""
    config = PPO(num_envs=1, n_steps=64, batch_size=64, update_epochs=1)

    def members() -> list[Member]:
        made = []
        for i in range(MEMBERS):
            width = (32, 48, 64)[i % 3]
            own = replace(config, network=Network((width, width), "relu"))
            member = Member(i, own, None)
            member.state = member.algorithm(SPACES).init([Seeds(7) / i])
            made.append(member)
        return made

    stacked, alone = members(), members()
    algorithm: Any
    algorithm, state = join(stacked, SPACES)
    for update in range(10):
        seeds = [Seeds(update) / m.number for m in stacked]
        algorithm.update(state, rollout(MEMBERS, 64), [s.torch() for s in seeds])
        for member, seed in zip(alone, seeds, strict=True):
            data, part = rollout(MEMBERS, 64), slice(member.number, member.number + 1)
            values = {f.name: getattr(data, f.name) for f in fields(data)}
            own: Any = {k: v[part] for k, v in values.items() if isinstance(v, torch.Tensor)}
            single: Any = member.algorithm(SPACES)
            single.update(member.state, replace(data, **own), [seed.torch()])
    split(algorithm, state, stacked, SPACES)
    return max(
        float((a.state.params - b.state.params).abs().max())
        for a, b in zip(stacked, alone, strict=True)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=800_000)
    parser.add_argument("--agilerl", help="an interpreter that has agilerl")
    given = parser.parse_args()
    warm_up()
    torch.set_num_threads(1)
    result: dict[str, Any] = {}
    rows, ratio = together_and_alone(given.seeds, given.steps)
    print(table(["seed", "one agent", f"{MEMBERS} members", "ratio"], rows))
    result["1: population / one agent"] = ratio
    if given.agilerl:
        result |= against_agilerl(given.seeds, given.steps, given.agilerl)
    result["3: 16 together / one by one"] = round(
        seconds(16, 64, 50) / (16 * seconds(1, 64, 50)), 3
    )
    result["5: largest change by growth"] = growth()
    result["6: largest difference in a stack"] = padded()
    print(table(["figure", "value"], [[k, v] for k, v in result.items()]))
    report("population", result)


if __name__ == "__main__":
    main()
