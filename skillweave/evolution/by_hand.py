"""One agent in a loop of one's own: it acts, learns from what it is given, and is saved."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self, cast

import numpy as np
import torch

from skillweave.algorithms.policy import make_algorithm
from skillweave.algorithms.quick import Quick, QuickPPO, Sampled
from skillweave.evolution.architecture import check_architecture
from skillweave.evolution.config import Mutations
from skillweave.evolution.mutation import mutate, with_settings
from skillweave.evolution.stacks import Member, Origin, copy
from skillweave.runs.agents import load_agent, save_agent
from skillweave.seeding import Seeds
from skillweave.training.by_hand import rollout_of, sample_of
from skillweave.types import Array


class ByHand:
    """A member of P = 1 with the spaces that it acts in and chance of its own.

    Args:
        member: with ``state`` None it begins with fresh weights.
        spaces: of observations and of actions.
    """

    def __init__(self, member: Member, spaces: tuple[Any, Any], seed: int) -> None:
        self.spaces, self.seeds, self.updates = spaces, Seeds(seed), 0
        self.rng, self.generator = (self.seeds / "act").numpy(), (self.seeds / "learn").torch()
        if member.state is None:
            member.state = make_algorithm(member.config, *spaces).init([self.seeds])
        self.become(member)

    def become(self, member: Member) -> None:
        """Go on as another member: mutated, say."""
        self.member, self.learner = member, member.algorithm(self.spaces)
        self.quick = self._quick()

    learner: Any

    def _quick(self) -> Any:
        kind = QuickPPO if hasattr(self.learner, "critic_net") else Quick
        return kind(self.learner, self.member.state)

    def set(self, **settings: Any) -> None:
        """Change settings of the algorithm."""
        self.become(with_settings(self.member, **settings))

    def mutate(self, by: Mutations, rng: np.random.Generator) -> Origin:
        """Change in at most one way; which one.

        Raises:
            SkillweaveError: an architecture that ``by`` cannot change.
        """
        check_architecture(self.member.config, by, "Mutations: ")
        self.become(mutate(self.member, by, self.spaces, rng))
        return self.member.origin

    def sample(self, obs: Any) -> Sampled:
        """Of PPO, for one observation or B: actions, log-probabilities, entropies, values."""
        return cast(Sampled, self.quick.sample(self.quick.rows(obs), self.rng))

    def act(
        self, obs: Any, *, explore: bool = True, epsilon: float = 0.0, mask: Any = None
    ) -> Array:
        """Actions (B, ...) in the environment's units, with the algorithm's own exploration.

        Args:
            epsilon: probability that all of them are drawn evenly instead.
            mask: (A,) or (B, A), allowed actions.
        """
        rows, learner = self.quick.rows(obs), self.learner
        allowed = None
        if mask is not None:
            allowed = torch.from_numpy(np.asarray(mask, bool).reshape(-1, learner.codec.size))
            allowed = allowed.expand(len(rows), -1)[None]
        with torch.inference_mode():
            if epsilon and self.rng.random() < epsilon:
                action = learner.random_actions([self.generator], len(rows), allowed)
            else:
                actor = learner.acting_params(self.member.state)
                if "epsilon" in actor.extra:  # said here at each call instead
                    actor.extra["epsilon"].zero_()
                noise = learner.noise([self.generator], 1, len(rows))[0] if explore else None
                obs = torch.from_numpy(rows)[None]
                action, _, _ = learner.act(actor, obs, allowed, noise)
        found: Array = learner.to_env(action[0].numpy())
        return found

    def learn_steps(self, *record: Any) -> dict[str, float]:
        """Learn from T steps, as of ``rollout_of``; metrics."""
        rollout = rollout_of(self.learner, self.member.state, *record)
        self.updates += 1
        rng = [(self.seeds / "update" / self.updates).torch()]
        _, report = self.learner.update(self.member.state, rollout, rng)
        self.quick = self._quick()
        return {k: float(v) for k, v in report.metrics.items()}

    def learn_sample(self, gamma: float, *record: Any) -> tuple[dict[str, float], Array]:
        """One gradient step on B transitions, as of ``sample_of``; metrics and errors (B,)."""
        sample = sample_of(self.learner, gamma, *record)
        _, report = self.learner.update(self.member.state, sample, [self.generator])
        self.quick = self._quick()
        return {k: float(v) for k, v in report.metrics.items()}, report.error[0].numpy()

    def copy(self, seed: int) -> Self:
        """The same agent with weights and chance of its own."""
        return type(self)(copy(self.member), self.spaces, seed)

    def save(self, path: str | Path, about: dict[str, Any]) -> None:
        """Write a policy that is also all that learning needs; ``about`` is plain JSON."""
        save_agent(path, self.learner, self.member.state, about)

    @classmethod
    def load(cls, path: str | Path, seed: int) -> tuple[Self, dict[str, Any]]:
        """The agent of a file, and what was said about it; see ``load_agent``."""
        algorithm, state, about = load_agent(path, Seeds(seed))
        spaces = algorithm.observation_space, algorithm.action_space
        return cls(Member(0, algorithm.config, state), spaces, seed), about
