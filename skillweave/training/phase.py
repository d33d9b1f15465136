"""A phase: one agent trained from its start, or from its latest clean cut, to its end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from skillweave.algorithms.config import AlgorithmConfig, config_from_json, config_to_json
from skillweave.algorithms.off_policy import OffPolicyAlgorithm
from skillweave.algorithms.policy import AgentPolicy, make_algorithm
from skillweave.algorithms.ppo import PPOAlgorithm
from skillweave.runs.directory import RunDirectory
from skillweave.seeding import Seeds
from skillweave.training.episodes import Tick
from skillweave.training.off_policy import train_off_policy
from skillweave.training.on_policy import train_on_policy
from skillweave.training.probe import MakeEnv, Probe

START = {"update": 0, "steps": 0, "seconds": 0.0, "metrics": {}}
"""Where a phase stands before its first update."""


class Listener(Protocol):
    """Is told how training goes: a progress bar, TensorBoard, Weights & Biases."""

    def phase(self, name: str, budget: int) -> None:
        """A phase begins, or goes on."""
        ...

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """An update was made."""
        ...

    def done(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """A phase is over."""
        ...


@dataclass(frozen=True)
class Phase:
    """What to train: a name, settings, a budget in environment steps, and an environment."""

    name: str
    config: AlgorithmConfig
    budget: int
    make_env: MakeEnv

    def entry(self) -> dict[str, Any]:
        """The manifest's entry before training."""
        return {
            "name": self.name,
            "budget": self.budget,
            "algorithm": config_to_json(self.config),
            "status": "waiting",
        }


def train_phase(
    phase: Phase, run: RunDirectory, seeds: Seeds, listeners: tuple[Listener, ...]
) -> AgentPolicy:
    """Train a phase to its end, or return its policy where it is done already.

    The settings in the run count, not those of ``phase``: a resumed run goes on as it began.
    """
    entry = run.phase(phase.name)
    if entry["status"] == "done":
        return run.load_policy(phase.name)
    config, budget = config_from_json(entry["algorithm"]), int(entry["budget"])
    env = phase.make_env(config.num_envs, config.gamma)
    every, episodes = run.manifest.get("eval_every"), run.manifest.get("eval_episodes", 0)
    probe = Probe(phase.make_env, config.gamma, seeds, every, episodes)
    try:
        algorithm = make_algorithm(config, env.observation_space, env.action_space)
        found = run.load_checkpoint(algorithm.state_type, phase.name)
        state, at, extra = found or (algorithm.init([seeds / "member" / 0]), dict(START), {})
        run.rewind_metrics(at.get("metrics_bytes", entry.get("metrics_bytes")))
        entry.setdefault("metrics_bytes", run.metrics_size())
        entry["status"] = "training"
        run.save()
        for listener in listeners:
            listener.phase(phase.name, budget)
        probe.start(at["steps"])

        def on_tick(tick: Tick) -> None:
            metrics = tick.metrics
            metrics |= probe.look(tick.steps, lambda: AgentPolicy.of(algorithm, tick.state))
            at.update(update=tick.update, steps=tick.steps, seconds=tick.seconds, metrics=metrics)
            now = {"phase": phase.name, "update": tick.update, "steps": tick.steps}
            run.log(now | {"seconds": round(tick.seconds, 4)} | metrics)
            for listener in listeners:
                listener.tick(phase.name, tick.steps, tick.seconds, metrics)
            if tick.cut:
                header = {"seconds": tick.seconds, "metrics": metrics}
                run.save_checkpoint(tick.state, now | header, tick.extra)

        where: dict[str, Any] = {k: at[k] for k in ("update", "steps", "seconds")}
        where |= {"cut_every": int(run.manifest["cut_every"]), "on_tick": on_tick}
        if isinstance(algorithm, PPOAlgorithm):
            train_on_policy(algorithm, env, state, seeds, budget, **where)
        elif isinstance(algorithm, OffPolicyAlgorithm):
            train_off_policy(algorithm, env, state, seeds, budget, saved=extra, **where)
    finally:
        env.close()
        probe.close()
    policy = AgentPolicy.of(algorithm, state)
    run.save_policy(phase.name, policy)
    _finish(run, entry, at)
    for listener in listeners:
        listener.done(phase.name, at["steps"], at["seconds"], at["metrics"])
    return policy


def _finish(run: RunDirectory, entry: dict[str, Any], at: dict[str, Any]) -> None:
    """Say in the manifest that a phase is done, and how it went."""
    entry.update(status="done", steps=at["steps"], seconds=round(at["seconds"], 3))
    entry.update(steps_per_second=round(at["steps"] / max(at["seconds"], 1e-9), 1))
    entry["final"] = at["metrics"]
    run.save()
