"""The loop of both training functions: episodes of every agent, with an evaluation at times."""

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from skillweave.compat.agilerl import stay_offline
from skillweave.compat.agilerl.agent import swapped
from skillweave.errors import DeclarationError, needs_extra

Result = tuple[list[Any], list[list[float]]]


class Epochs(SimpleNamespace):
    """The arguments of a training function, and the loop that it runs."""

    env: Any
    pop: Any

    def run(self, episode: Callable[[Any, int], Any]) -> Result:
        """Train; ``episode`` plays one episode of an agent, lets it learn and returns the loss."""
        if self.accelerator is not None or not self.pop:
            raise DeclarationError("pop must have an agent, and accelerator be None")
        if not hasattr(self.env, "num_envs"):
            one = self.env
            self.env = SyncVectorEnv([lambda: one], autoreset_mode=AutoresetMode.SAME_STEP)
        if self.env.metadata.get("autoreset_mode") != AutoresetMode.SAME_STEP:
            raise DeclarationError("env must reset in the same step: make it with makeVectEnvs")
        name = f"{self.env_name}-EvoHPO-{self.algo}"
        scores = []
        self.tracked = self._wandb_run(name) if self.wb else None
        for number in range(1, self.n_episodes + 1):
            losses = [self._scored(agent, episode(agent, number - 1)) for agent in self.pop]
            if number % self.evo_epochs == 0:
                how = self.swap_channels, self.max_steps, self.evo_loop
                scores.append([agent.test(self.env, *how) for agent in self.pop])
                self._report(number, scores[-1], losses)
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
        if self.tracked:
            self.tracked.finish()
        return self.pop, scores

    def steps(self, act: Callable[[Any], Any]) -> Iterator[tuple[Any, ...]]:
        """Yield the steps of an episode: state, ``act``'s result, rewards, next state, ends."""
        self.rewards = []
        self.ended = []
        state = swapped(self.env.reset()[0], self.swap_channels)
        for _ in range(self.max_steps):
            acted = act(state)
            after, reward, ended, _, _ = self.env.step(
                acted[0] if isinstance(acted, tuple) else acted
            )
            after = swapped(after, self.swap_channels)
            self.rewards.append(reward)
            self.ended.append(ended)
            yield state, acted, reward, after, ended
            state = after

    def _wandb_run(self, name: str) -> Any:
        """Start a run of Weights & Biases; offline without login or key."""
        with needs_extra("tracking with wandb", "wandb"):
            import wandb
        stay_offline()
        key = self.wandb_api_key
        if key is not None:
            wandb.login(key=key)
        settings = {**(self.INIT_HP or {}), **(self.MUT_P or {})}
        mode: Any = None if key is None else "online"
        return wandb.init(project="AgileRL", name=name, config=settings, mode=mode)

    def _scored(self, agent: Any, loss: Any) -> Any:
        """Record the mean return of the first episodes of all environments."""
        first = np.cumsum(self.ended, axis=0) - np.array(self.ended, int) == 0
        agent.scores.append(float((np.array(self.rewards) * first).sum(0).mean()))
        agent.steps[-1] += self.max_steps
        return loss

    def _report(self, number: int, tested: list[float], losses: list[Any]) -> None:
        """Print and track the scores and fitness of AgileRL's agents."""
        scores = [float(np.mean(agent.scores[-self.evo_epochs :])) for agent in self.pop]
        if self.tracked:
            metrics = {"train/mean_score": np.mean(scores), "eval/mean_fitness": np.mean(tested)}
            metrics |= {f"train/agent_{i}_loss": loss for i, loss in enumerate(losses)}
            steps = sum(agent.steps[-1] for agent in self.pop)
            self.tracked.log({"global_step": steps, "eval/best_fitness": max(tested), **metrics})
        for agent, score, fitness in zip(self.pop, scores, tested, strict=True):
            if self.verbose:
                print(
                    f"{self.env_name}, episode {number}, agent {agent.index}: {agent.steps[-1]} "
                    f"steps, score {score:.2f}, fitness {fitness:.2f}, mutation {agent.mut}"
                )
            agent.steps.append(agent.steps[-1])


def _stem(path: str | None, otherwise: str) -> str:
    return (path or otherwise).split(".pt")[0]
