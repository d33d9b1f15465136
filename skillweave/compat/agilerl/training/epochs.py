"""What both training functions share: episodes of everyone, and now and then an evaluation."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from skillweave.runs.trackers import import_wandb
from skillweave.types import SkillweaveError

Result = tuple[list[Any], list[list[float]]]


class Epochs(SimpleNamespace):
    """The arguments of a training function, which says what an episode of an agent is."""

    env: Any
    pop: Any

    def run(self, episode: Callable[[Any, int], tuple[Any, Any, Any]]) -> Result:
        """Train; ``episode`` answers rewards and terminations (T, N), and the loss."""
        if self.accelerator is not None or not self.pop:
            raise SkillweaveError("pop must have an agent, and accelerator be None")
        if not hasattr(self.env, "num_envs"):
            one = self.env
            self.env = SyncVectorEnv([lambda: one], autoreset_mode=AutoresetMode.SAME_STEP)
        if self.env.metadata.get("autoreset_mode") != AutoresetMode.SAME_STEP:
            raise SkillweaveError("env must reset in the same step: make it with makeVectEnvs")
        name, found = f"{self.env_name}-EvoHPO-{self.algo}", []
        self.wandb = import_wandb() if self.wb else None
        if self.wandb:
            if self.wandb_api_key is not None:
                self.wandb.login(key=self.wandb_api_key)
            mode = None if self.wandb_api_key is None else "online"
            settings = {**(self.INIT_HP or {}), **(self.MUT_P or {})}
            self.wandb.init(project="AgileRL", name=name, config=settings, mode=mode)
        for done in range(self.n_episodes):
            losses = [self._score(agent, *episode(agent, done)) for agent in self.pop]
            number = done + 1
            if number % self.evo_epochs == 0:
                how = self.swap_channels, self.max_steps, self.evo_loop
                found.append([agent.test(self.env, *how) for agent in self.pop])
                self._tell(number, found[-1], losses)
                means = [np.mean(agent.fitness[-100:]) for agent in self.pop]
                if self.target is not None and number > 100 and min(means) > self.target:
                    break
                if self.tournament is not None and self.mutation is not None:
                    elite, heirs = self.tournament.select(self.pop)
                    self.pop = self.mutation.mutation(heirs)
                    if self.save_elite and number == self.n_episodes:
                        elite.saveCheckpoint(_stem(self.elite_path, f"{name}-elite") + ".pt")
            if self.checkpoint is not None and number % self.checkpoint == 0:
                for i, agent in enumerate(self.pop):
                    agent.saveCheckpoint(f"{_stem(self.checkpoint_path, name)}_{i}_{number}.pt")
        if self.wandb:
            self.wandb.finish()
        return self.pop, found

    def _score(self, agent: Any, rewards: Any, ended: Any, loss: Any) -> Any:
        """Note the mean return of the first episodes of all environments."""
        first = np.cumsum(ended, axis=0) - np.asarray(ended, int) == 0
        agent.scores.append(float((np.array(rewards) * first).sum(0).mean()))
        agent.steps[-1] += self.max_steps
        return loss

    def _tell(self, number: int, tested: list[float], losses: list[Any]) -> None:
        scores = [float(np.mean(agent.scores[-self.evo_epochs :])) for agent in self.pop]
        if self.wandb:
            told = {"train/mean_score": np.mean(scores), "eval/mean_fitness": np.mean(tested)}
            told |= {f"train/agent_{i}_loss": loss for i, loss in enumerate(losses)}
            steps = sum(agent.steps[-1] for agent in self.pop)
            self.wandb.log({"global_step": steps, "eval/best_fitness": max(tested), **told})
        for agent, score, fitness in zip(self.pop, scores, tested, strict=True):
            if self.verbose:
                print(
                    f"{self.env_name}, episode {number}, agent {agent.index}: {agent.steps[-1]} "
                    f"steps, score {score:.2f}, fitness {fitness:.2f}, mutation {agent.mut}"
                )
            agent.steps.append(agent.steps[-1])


def swapped(state: Any, swap: bool) -> Any:
    """Observations with their channels first, where asked for."""
    return np.moveaxis(state, -1, -3) if swap else state


def _stem(path: str | None, otherwise: str) -> str:
    return (path or otherwise).split(".pt")[0]
