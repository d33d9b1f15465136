"""A stage: one agent trained from its start, or from its latest clean cut, to its end."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Protocol

from torch import Tensor

from skillweave.algorithms.config import AlgorithmConfig, config_from_json, config_to_json
from skillweave.algorithms.off_policy import OffPolicyAlgorithm
from skillweave.algorithms.policy import AgentPolicy, make_algorithm
from skillweave.algorithms.ppo import PPOAlgorithm
from skillweave.runs.directory import RunDirectory
from skillweave.seeding import Seeds
from skillweave.training.collector import Collector
from skillweave.training.episodes import Tick
from skillweave.training.off_policy import make_buffer, train_off_policy
from skillweave.training.on_policy import train_on_policy
from skillweave.training.probe import MakeEnv, Probe
from skillweave.types import SkillweaveError, unprefixed

START = {"update": 0, "steps": 0, "evaluation_steps": 0, "seconds": 0.0, "metrics": {}}
"""Where a stage stands before its first update."""


class Listener(Protocol):
    """Is told how training goes: a progress bar, TensorBoard, Weights & Biases."""

    def stage(self, name: str, budget: int) -> None:
        """A stage begins, or goes on."""
        ...

    def tick(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """An update was made."""
        ...

    def done(self, name: str, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """A stage is over."""
        ...

    def message(self, text: str) -> None:
        """Something that people should know."""
        ...


class Trainer(Protocol):
    """How a stage is trained: by one agent, or by a population."""

    def __call__(
        self, stage: Stage, run: RunDirectory, seeds: Seeds, listeners: tuple[Listener, ...]
    ) -> AgentPolicy:
        """Train it to its end, or return its policy where it is done already."""
        ...


@dataclass(frozen=True)
class Stage:
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


def check_replay(entry: dict[str, Any], observation_space: Any, action_space: Any) -> None:
    """Raise a SkillweaveError where a stage's replay buffer cannot be made.

    Args:
        entry: the manifest's; "evolution" says of how many members.
    """
    config = config_from_json(entry["algorithm"])
    algorithm = make_algorithm(config, observation_space, action_space)
    if not isinstance(algorithm, OffPolicyAlgorithm):
        return
    members = int((entry.get("evolution") or {"population": 1})["population"])
    env: Any = SimpleNamespace(
        num_envs=config.num_envs * members, observation_space=observation_space
    )
    try:
        make_buffer(algorithm, env, members, shared=True)  # what is not written takes no memory
    except SkillweaveError as error:
        raise SkillweaveError(f"stage {entry['name']!r}: {error}") from error


class Record:
    """What a stage under way writes and tells: its entry, its metrics, its listeners."""

    def __init__(
        self, name: str, run: RunDirectory, listeners: tuple[Listener, ...], at: dict[str, Any]
    ) -> None:
        self.run, self.listeners, self.entry, self.at = run, listeners, run.stage(name), at
        run.rewind_metrics(at.get("metrics_bytes", self.entry.get("metrics_bytes")))
        self.entry.setdefault("metrics_bytes", run.metrics_size())
        self.entry["status"] = "training"
        run.save()
        for listener in listeners:
            listener.stage(name, int(self.entry["budget"]))

    def tick(self, update: int, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """An update was made."""
        name = self.entry["name"]
        self.at.update(update=update, steps=steps, seconds=seconds, metrics=metrics)
        now = {"stage": name, "update": update, "steps": steps}
        self.run.log(now | {"seconds": round(seconds, 4)} | metrics)
        for listener in self.listeners:
            listener.tick(name, steps, seconds, metrics)

    def tell(self, text: str) -> None:
        """Something that people should know."""
        for listener in self.listeners:
            listener.message(f"{self.entry['name']}: {text}")

    def header(self) -> dict[str, Any]:
        """Where the stage stands, for its checkpoint."""
        return {"stage": self.entry["name"]} | {
            k: self.at[k] for k in ("update", "steps", "evaluation_steps", "seconds", "metrics")
        }

    def done(self, policy: AgentPolicy) -> None:
        """The stage is over: keep its policy, and say how it went."""
        entry, at = self.entry, self.at
        self.run.save_policy(entry["name"], policy)
        entry.update(status="done", steps=at["steps"], seconds=round(at["seconds"], 3))
        entry["evaluation_steps"] = at["evaluation_steps"]
        entry.update(steps_per_second=round(at["steps"] / max(at["seconds"], 1e-9), 1))
        entry["final"] = at["metrics"]
        self.run.save()
        self.run.drop_checkpoints()
        for listener in self.listeners:
            listener.done(entry["name"], at["steps"], at["seconds"], at["metrics"])


def resume_episodes(
    collector: Collector, saved: dict[str, Tensor], seeds: Seeds, record: Record
) -> None:
    """Bring the environments back to where a checkpoint left them; say where that cannot be."""
    if not saved:
        return
    try:
        collector.restore(saved, seeds / "restart" / record.at["update"])
    except (KeyError, IndexError, ValueError, TypeError, RuntimeError) as error:
        raise SkillweaveError(
            f"{record.run.path}: the checkpoint of stage {record.entry['name']!r} does not hold "
            f"episodes of these environments: {error!r}"
        ) from error
    if count := len(collector.begun_anew):
        record.tell(
            f"{count} of {collector.num_envs} open episodes begin anew, so the end may differ from "
            "that of an undisturbed run: given the same seed and the same actions, the environment "
            "does not repeat itself"
        )


def train_stage(
    stage: Stage, run: RunDirectory, seeds: Seeds, listeners: tuple[Listener, ...]
) -> AgentPolicy:
    """Train a stage to its end, or return its policy where it is done already.

    The settings in the run count, not those of ``stage``: a resumed run goes on as it began.
    """
    entry = run.stage(stage.name)
    if entry["status"] == "done":
        return run.load_policy(stage.name)
    config, budget = config_from_json(entry["algorithm"]), int(entry["budget"])
    env = stage.make_env(config.num_envs, config.gamma)
    every, episodes = run.manifest.get("eval_every"), run.manifest.get("eval_episodes", 0)
    probe = Probe(stage.make_env, config.gamma, seeds, every, episodes)
    try:
        algorithm = make_algorithm(config, env.observation_space, env.action_space)
        fresh = algorithm.init([seeds / "member" / 0])
        found = run.load_checkpoint(algorithm.state_type, stage.name, like=fresh)
        state, at, extra = found or (fresh, dict(START), {})
        record = Record(stage.name, run, listeners, at)
        collector = Collector(env)
        resume_episodes(collector, unprefixed("collector", extra), seeds, record)
        probe.start(at["steps"])

        def on_tick(tick: Tick) -> None:
            metrics = tick.metrics
            metrics |= probe.look(tick.steps, lambda: AgentPolicy.of(algorithm, tick.state))
            record.at["evaluation_steps"] += probe.spent()
            record.tick(tick.update, tick.steps, tick.seconds, metrics)
            if tick.cut:
                run.save_checkpoint(tick.state, record.header(), tick.extra)

        where: dict[str, Any] = {k: at[k] for k in ("update", "steps", "seconds")}
        where |= {"cut_every": int(run.manifest["cut_every"]), "on_tick": on_tick}
        if isinstance(algorithm, PPOAlgorithm):
            train_on_policy(algorithm, collector, state, seeds, budget, **where)
        elif isinstance(algorithm, OffPolicyAlgorithm):
            saved = unprefixed("buffer", extra)
            train_off_policy(algorithm, collector, state, seeds, budget, saved=saved, **where)
    finally:
        env.close()
        probe.close()
    policy = AgentPolicy.of(algorithm, state)
    record.done(policy)
    return policy
