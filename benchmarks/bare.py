"""One agent trained by the library's loop alone: no run directory, no command line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from skillweave import EnvSpec
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.registry import make_algorithm
from skillweave.experience.acting import Acting
from skillweave.experience.group import Collectors
from skillweave.training.episodes import Episodes, Tick
from skillweave.training.learner import Stack
from skillweave.training.learning_task import skill_task
from skillweave.training.loop import Loop
from skillweave.training.role import agent_role
from skillweave.training.stack_learner import learner_of


def train_bare(
    spec: EnvSpec,
    config: Any,
    seeds: Seeds,
    steps: int,
    on_tick: Callable[[Tick, Stack], None],
) -> Stack:
    """Train an agent; ``on_tick`` is called with every report."""
    learning_task = skill_task(agent_role(spec))
    algorithm = make_algorithm(config, *learning_task.role.spaces)
    stack = Stack(algorithm, algorithm.init([seeds / "member" / 0]))
    learner = learner_of(stack, config.num_envs, seeds)
    acting = Acting([(algorithm, 1)], config.num_envs)
    collectors = Collectors([learning_task.collector(config.num_envs, acting)])
    try:
        Loop(
            learner,
            collectors,
            Episodes(),
            seeds,
            steps,
            on_tick=lambda tick: on_tick(tick, stack),
        ).run()
    finally:
        collectors.close()
    return stack
