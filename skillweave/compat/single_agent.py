"""One agent for a user's training loop: it acts, learns, and is a file."""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
import torch

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.base import Algorithm
from skillweave.algorithms.policy import AgentHeader, AgentPolicy, make_algorithm, state_from
from skillweave.compat.batches import rollout_of, sample_of
from skillweave.compat.numpy_actor import NumpyActor, NumpyPPOActor, Sampled
from skillweave.errors import RunError
from skillweave.evolution.architecture import check_architecture
from skillweave.evolution.config import Mutations
from skillweave.evolution.mutation import mutate, with_settings
from skillweave.evolution.stacks import Member, copy
from skillweave.policies.files import check_file
from skillweave.runs.files import read_tensors, record_in, write_tensors
from skillweave.runs.manifest import Origin
from skillweave.types import Array


class SingleAgent:
    """A member of P = 1 with its spaces and its own random streams.

    Args:
        member: if its ``state`` is None, it starts with fresh weights.
        spaces: the observation space and the action space.
        seed: the root of its random streams.
    """

    def __init__(self, member: Member, spaces: tuple[Any, Any], seed: int) -> None:
        self.spaces = spaces
        self.seeds = Seeds(seed)
        self.updates = 0
        self.rng = (self.seeds / "act").numpy()
        self.generator = (self.seeds / "learn").torch()
        if member.state is None:
            member.state = make_algorithm(member.config, *spaces).init([self.seeds])
        self.become(member)

    def become(self, member: Member) -> None:
        """Continue as another member, for example a mutated one."""
        self.member = member
        self.learner = member.algorithm(self.spaces)
        self.numpy_actor = self._make_numpy_actor()

    learner: Any

    def _make_numpy_actor(self) -> Any:
        kind = NumpyPPOActor if hasattr(self.learner, "critic_net") else NumpyActor
        return kind(self.learner, self.member.state)

    def set(self, **settings: Any) -> None:
        """Change hyperparameters of the algorithm."""
        self.become(with_settings(self.member, **settings))

    def mutate(self, by: Mutations, rng: np.random.Generator) -> Origin:
        """Mutate in at most one way; return the name of the mutation.

        Raises:
            DeclarationError: ``by`` cannot change this architecture.
        """
        check_architecture(self.member.config, by, "Mutations: ")
        self.become(mutate(self.member, by, self.spaces, rng))
        return self.member.origin

    def sample(self, obs: Any) -> Sampled:
        """Return PPO's actions, log-probabilities, entropies and values; one observation or B."""
        return cast(Sampled, self.numpy_actor.sample(self.numpy_actor.rows(obs), self.rng))

    def act(
        self, obs: Any, *, explore: bool = True, epsilon: float = 0.0, mask: Any = None
    ) -> Array:
        """Return actions (B, ...) in the environment's units.

        Args:
            explore: whether the algorithm adds its own exploration.
            epsilon: probability that all actions are drawn uniformly instead.
            mask: (A,) or (B, A), allowed actions.
        """
        rows = self.numpy_actor.rows(obs)
        learner = self.learner
        allowed = None
        if mask is not None:
            allowed = torch.from_numpy(np.asarray(mask, bool).reshape(-1, learner.codec.size))
            allowed = allowed.expand(len(rows), -1)[None]
        with torch.inference_mode():
            if epsilon and self.rng.random() < epsilon:
                action = learner.random_actions([self.generator], len(rows), allowed)
            else:
                actor = learner.acting_params(self.member.state)
                if "epsilon" in actor.extra:  # the warning comes here, at each call, instead
                    actor.extra["epsilon"].zero_()
                noise = learner.noise([self.generator], 1, len(rows))[0] if explore else None
                obs = torch.from_numpy(rows)[None]
                action, _, _ = learner.act(actor, obs, allowed, noise)
        actions: Array = learner.to_env(action[0].numpy())
        return actions

    def learn_steps(self, *record: Any) -> dict[str, float]:
        """Learn from T steps, given as to ``rollout_of``; return metrics."""
        rollout = rollout_of(self.learner, self.member.state, *record)
        self.updates += 1
        rng = [(self.seeds / "update" / self.updates).torch()]
        _, report = self.learner.update(self.member.state, rollout, rng)
        self.numpy_actor = self._make_numpy_actor()
        return {k: float(v) for k, v in report.metrics.items()}

    def learn_sample(self, gamma: float, *record: Any) -> tuple[dict[str, float], Array]:
        """Make one gradient step on B transitions of ``sample_of``; return metrics, errors (B,)."""
        sample = sample_of(self.learner, gamma, *record)
        _, report = self.learner.update(self.member.state, sample, [self.generator])
        self.numpy_actor = self._make_numpy_actor()
        return {k: float(v) for k, v in report.metrics.items()}, report.error[0].numpy()

    def copy(self, seed: int) -> Self:
        """Return the same agent with its own copy of the weights and its own random streams."""
        return type(self)(copy(self.member), self.spaces, seed)

    def save(self, path: str | Path, about: dict[str, Any]) -> None:
        """Write the policy and all that learning needs; ``about`` is plain JSON."""
        save_agent(path, self.learner, self.member.state, about)

    @classmethod
    def load(cls, path: str | Path, seed: int) -> tuple[Self, dict[str, Any]]:
        """Return the agent in a file, and its ``about``; see ``load_agent``."""
        algorithm, state, about = load_agent(path, Seeds(seed))
        spaces = algorithm.observation_space, algorithm.action_space
        return cls(Member(0, algorithm.config, state), spaces, seed), about


def save_agent(path: str | Path, algorithm: Algorithm, state: Any, about: dict[str, Any]) -> None:
    """Write the one member of a state; ``about`` is plain JSON."""
    tensors, header = AgentPolicy.of(algorithm, state).to_file()
    tensors = tensors | {f"state.{k}": v for k, v in vars(state).items()}
    write_tensors(Path(path), tensors, replace(header, about=about))


def load_agent(path: str | Path, seeds: Seeds) -> tuple[Algorithm, Any, dict[str, Any]]:
    """Return the algorithm, its state, and the ``about`` that was saved with it.

    A file that holds a policy alone gives the weights; everything else starts fresh.

    Raises:
        RunError: the file is missing, damaged, a pickle, or holds no agent.
    """
    check_file(Path(path))
    if zipfile.is_zipfile(path):
        raise RunError(
            f"{path} is a pickle of torch.save's, and a pickle can run code. If it is a checkpoint "
            "of AgileRL's and you trust where it comes from, convert it: skillweave "
            f"import-agilerl {path} --trust"
        )
    tensors, header = read_tensors(Path(path))
    of: AgentHeader = record_in(AgentHeader, header, path)
    algorithm = AgentPolicy.from_file(tensors, of, str(path)).algorithm
    state = algorithm.init([seeds])
    algorithm.set_weights(state, tensors)
    saved = {k[len("state.") :]: v for k, v in tensors.items() if k.startswith("state.")}
    if saved:
        state = state_from(vars(state) | saved, state, str(path), algorithm.parameter_groups())
    return algorithm, state, of.about
