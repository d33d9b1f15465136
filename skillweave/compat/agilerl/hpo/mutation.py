"""AgileRL's mutations."""

from typing import Any

import numpy as np

from skillweave.compat.agilerl.agent import random_seed
from skillweave.errors import DeclarationError
from skillweave.evolution.architecture import check_architecture
from skillweave.evolution.config import KINDS, Mutations as Native, Range
from skillweave.evolution.mutation import mutate

_WORDS = {
    "none": "None",
    "architecture": "arch",
    "parameters": "param",
    "activation": "act",
    "learning_rate": "lr",
    "batch_size": "bs",
    "update_ratio": "ls",
}


class Mutations:
    """Mutations between generations; probabilities are relative to their sum."""

    def __init__(
        self,
        algo: Any,
        no_mutation: float,
        architecture: float,
        new_layer_prob: float,
        parameters: float,
        activation: float,
        rl_hp: float,
        rl_hp_selection: list[str],
        mutation_sd: float,
        min_lr: float = 0.0001,
        max_lr: float = 0.01,
        min_learn_step: int = 1,
        max_learn_step: int = 120,
        min_batch_size: int = 8,
        max_batch_size: int = 1024,
        agent_ids: Any = None,
        arch: str = "mlp",
        mutate_elite: bool = True,
        rand_seed: int | None = None,
        device: Any = "cpu",
        accelerator: Any = None,
    ) -> None:
        known = {
            "lr": ("learning_rate", Range(min_lr, max_lr)),
            "batch_size": ("batch_size", Range(min_batch_size, max_batch_size)),
            "learn_step": ("update_ratio", Range(1 / max_learn_step, 1 / min_learn_step)),
        }
        if unknown := set(rl_hp_selection or ()) - set(known):
            raise DeclarationError(f"rl_hp_selection has {unknown}; there are: {', '.join(known)}")
        self._ranges = dict(known[k] for k in rl_hp_selection or ())
        self._kinds = np.array([no_mutation, rl_hp, parameters, architecture, activation], float)
        self._how: Any = {"strength": mutation_sd, "layer_share": new_layer_prob}
        self.mutate_elite = mutate_elite
        self.rng = np.random.default_rng(random_seed() if rand_seed is None else rand_seed)

    def mutation(self, population: list[Any], pre_training_mut: bool = False) -> list[Any]:
        """Return the agents, each changed in at most one way; its ``mut`` names the change."""
        kinds = self._kinds * [not pre_training_mut, 1, 1, 1, 1]
        for i, agent in enumerate(population if kinds.any() else ()):
            agent.mut = "None"
            if i > 0 or self.mutate_elite:
                config = agent.member.config
                ranges = {k: r for k, r in self._ranges.items() if hasattr(config, k)}
                chances = dict(zip(KINDS, (kinds / kinds.sum()).tolist(), strict=True))
                by = Native(**chances, ranges=ranges, **self._how)
                check_architecture(config, by, "Mutations: ")
                agent.become(mutate(agent.member, by, agent.spaces, self.rng))
                change = agent.member.origin
                agent.mut = _WORDS.get(change.mutation) or _WORDS[next(iter(change.changes))]
        return population
