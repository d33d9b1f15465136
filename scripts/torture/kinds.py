"""Tiny trainings of every kind: what is killed, what meets a bad disk, whose files are mutated."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete

from skillweave import (
    DQN,
    PPO,
    SAC,
    Apart,
    EnvSpec,
    Hierarchy,
    Lengths,
    Network,
    Reflex,
    Selection,
    Skill,
    Together,
    TrainDefaults,
)
from skillweave.algorithms import RNN
from skillweave.api import Agent, Run
from skillweave.evolution import Evolution, Mutations

SEED = 3
"""Of every training."""
CART, SHORT_CART, TINY = "CartPole-v1", "TortureCart-v0", "TortureTiny-v0"
IN_PYTHON = EnvSpec(SHORT_CART, engine="sync", workers=1)
TINY_IN_PYTHON = EnvSpec(TINY, engine="sync", workers=1)
# One process, said: how many are best is measured, and may differ while other programs run.


class Tiny(gym.Env[Any, Any]):
    """Eight steps of a walk; Dict observations, continuous actions."""

    observation_space = Dict(place=Box(-9.0, 9.0, (2,), np.float32), lamp=Discrete(3))
    action_space = Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, render_mode: str | None = None) -> None:
        pass

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Start somewhere."""
        super().reset(seed=seed)
        self.place, self.t = self.np_random.uniform(-1, 1, 2).astype(np.float32), 0
        return self._seen(), {}

    def step(self, action: Any) -> Any:
        """Go where the action says, and a little elsewhere."""
        self.t += 1
        self.place[0] += action[0] + 0.1 * self.np_random.normal()
        self.place = self.place.clip(-9, 9)
        return self._seen(), -float(abs(self.place[0])), self.t == 8, False, {}

    def _seen(self) -> Any:
        return {"place": self.place.copy(), "lamp": self.t % 3}


if TINY not in gym.registry:
    gym.register(TINY, Tiny)
    # Episodes of 60 steps: a case plays some, and there are many cases.
    gym.register(
        SHORT_CART, "gymnasium.envs.classic_control.cartpole:CartPoleEnv", max_episode_steps=60
    )


class Left(Skill):
    """Keeps the cart on the left."""

    max_steps = 15

    def reward(self, step: Any) -> Any:
        """More on the left."""
        return -step.next_obs[:, 0] + 0.1 * step.timed_out


class Balance(Skill):
    """CartPole's own task."""


class Leaning(Skill):
    """May start only where the pole leans to the right, which has to be looked for."""

    max_steps = 9

    def initiation(self, obs: Any) -> Any:
        """Return whether the pole leans."""
        return obs[:, 2] > 0.01


def leans_left(obs: Any) -> Any:
    """Return where the pole is about to fall to the left."""
    return obs[:, 2] < -0.15


@dataclass(frozen=True)
class Kind:
    """One training: how it is declared, how it evolves, and in which other run it learnt before."""

    declare: Callable[[], Hierarchy | Agent]
    evolve: Evolution | None = None
    before: Callable[[], Hierarchy | Agent] | None = None

    def train(self, run: Path) -> Run:
        """Train from the start, after the run that it starts from."""
        other = _before(run)
        try:
            learnt = self.before and self.before().train(other, seed=SEED, quiet=True)
            return self.declare().train(
                run, seed=SEED, quiet=True, evolve=self.evolve, start_from=learnt
            )
        finally:
            shutil.rmtree(other, ignore_errors=True)

    def go_on(self, run: Path) -> Run:
        """Do what a user does after a kill: resume the run, or begin where there is none."""
        shutil.rmtree(_before(run), ignore_errors=True)  # a run needs no other one to go on
        if (run / "run.json").exists():
            return self.declare().resume(run, quiet=True)
        if run.exists():
            shutil.rmtree(run)
        return self.train(run)


def _before(run: Path) -> Path:
    """Return where the run is that another one starts from."""
    return run.with_name(f"{run.name}-before")


NET = Network((6,))
LEARNS: dict[str, Any] = {"num_envs": 4, "n_steps": 16, "batch_size": 32, "update_epochs": 2}
REPLAYS: dict[str, Any] = {
    "num_envs": 4,
    "batch_size": 8,
    "learning_starts": 40,
    "buffer_size": 200,
    "update_ratio": 0.25,
    "network": Network((6,), "relu"),
}
EVOLVES: dict[str, Any] = {
    "population": 3,
    "generations": 3,
    "episodes": 2,
    "mutations": Mutations(units=(4, 16), layers=(1, 2)),
}


def hierarchy_of(steps: int, skill: Any, selector: Any) -> Hierarchy:
    """Return two skills and a selector."""
    return Hierarchy(
        IN_PYTHON,
        [Left(), Balance()],
        call_steps=6,
        algorithm=skill,
        selector=selector,
        learn="apart",
        apart=Apart(skill_steps=steps, selector_steps=steps),
        train_defaults=TrainDefaults(checkpoint_every=steps // 4),
    )


def alone(env: Any, algorithm: Any, steps: int) -> Agent:
    """Return one agent."""
    often = TrainDefaults(checkpoint_every=max(1, steps // 5))
    return Agent(env, algorithm, steps, train_defaults=often)


def together(steps: int) -> Hierarchy:
    """Two skills and a selector that learn at once, on-policy."""
    return Hierarchy(
        IN_PYTHON,
        [Left(), Leaning()],
        call_steps=Lengths(2, 4, 8),
        learn="together",
        together=Together(quota=1.0, interrupt=True, steps=steps),
        algorithm=PPO(**LEARNS, network=NET),
        selector=PPO(**LEARNS, network=NET),
        selection=Selection(greedy_skills=False),
        train_defaults=TrainDefaults(checkpoint_every=steps // 4),
    )


def together_replay(steps: int) -> Hierarchy:
    """Two skills and a selector that learn from replay, apart, then together."""
    return Hierarchy(
        IN_PYTHON,
        [Left(), Leaning()],
        call_steps=4,
        learn="apart, then together",
        algorithm=DQN.rainbow(**REPLAYS),
        selector=SAC(**REPLAYS),
        apart=Apart(skill_steps=steps, selector_steps=steps),
        together=Together(steps=2 * steps),
        train_defaults=TrainDefaults(checkpoint_every=steps // 2),
    )


KINDS: dict[str, Kind] = {
    "skills and selector": Kind(
        lambda: hierarchy_of(1200, PPO(**LEARNS, network=NET), PPO(**LEARNS, network=NET))
    ),
    "skills and selector, replay": Kind(
        lambda: hierarchy_of(500, DQN.rainbow(**REPLAYS), SAC(**REPLAYS))
    ),
    "replay of continuous actions": Kind(
        lambda: alone(TINY_IN_PYTHON, SAC(**REPLAYS, normalize_obs=True, n_step=3), 800)
    ),
    "recurrent": Kind(
        lambda: alone(
            IN_PYTHON,
            PPO(**LEARNS | {"batch_size": 64}, network=Network((6,), rnn=RNN("gru", 4))),
            2000,
        )
    ),
    "envpool": Kind(
        lambda: alone(CART, PPO(**LEARNS, network=NET, normalize_obs=True, target_kl=0.02), 4000)
    ),
    "workers": Kind(
        lambda: alone(EnvSpec(CART, engine="sync", workers=2), PPO(**LEARNS, network=NET), 2000)
    ),
    "population": Kind(
        lambda: alone(IN_PYTHON, PPO(**LEARNS, network=NET), 800),
        evolve=Evolution(**EVOLVES),
    ),
    "search for a start": Kind(
        lambda: Hierarchy(
            IN_PYTHON,
            [Leaning(), Balance()],
            call_steps=4,
            algorithm=PPO(**LEARNS, network=NET),
            selector=DQN(**REPLAYS | {"update_ratio": 0.02}),
            reflexes=[Reflex(leans_left, 0)],
            learn="apart",
            apart=Apart(skill_steps=600, selector_steps=600),
            train_defaults=TrainDefaults(checkpoint_every=150, eval_every=200, eval_episodes=2),
        ),
    ),
    "populations of skills and selector": Kind(
        lambda: Hierarchy(
            IN_PYTHON,
            [Leaning(), Balance()],
            call_steps=4,
            algorithm=PPO(**LEARNS | {"batch_size": 64}, network=Network((6,), rnn=RNN("gru", 4))),
            selector=DQN(**REPLAYS),
            learn="apart",
            apart=Apart(skill_steps=300, selector_steps=300),
        ),
        evolve=Evolution(**EVOLVES | {"population": 2, "generations": 2}),
    ),
    "together": Kind(lambda: together(1200)),
    "apart, then together, replay": Kind(lambda: together_replay(200)),
    "start from another run": Kind(
        lambda: together_replay(200), before=lambda: together_replay(100)
    ),
    "population, replay": Kind(
        lambda: alone(IN_PYTHON, DQN(**REPLAYS), 300),
        evolve=Evolution(**EVOLVES),
    ),
}
"""Every kind of stage and engine that could lose something."""
