"""A stage in which a selector and its skills learn together, from the same steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.base import Algorithm, state_to
from skillweave.algorithms.config import AlgorithmConfig, config_from_json
from skillweave.algorithms.policy import AgentPolicy, checked_tensor, make_algorithm, state_from
from skillweave.buffers.rollout import RolloutStore
from skillweave.collecting.acting import Acting, Request
from skillweave.collecting.collector import Collector
from skillweave.collecting.woven import WovenCollector
from skillweave.envs.checks import LONGEST_EPISODE
from skillweave.envs.engine import Engine
from skillweave.envs.make import make_engine
from skillweave.experience import Anchor, Experience
from skillweave.ops.device import resolve_device
from skillweave.ops.threads import torch_threads
from skillweave.runs.states import load_state
from skillweave.seeding import Seeds
from skillweave.training.episodes import Tick
from skillweave.training.learner import Learner, RolloutLearner, Stack
from skillweave.training.replay_learner import ReplayLearner, store_of
from skillweave.training.scene import WovenScene
from skillweave.training.stage import CRITIC, SELECTOR, Together
from skillweave.training.stage_log import StageLog
from skillweave.training.trainer import OneAgent, StageRun, keep_to_guide
from skillweave.types import Array, prefixed, unprefixed


class WovenLearner:
    """A selector and skills, each with a learner of its own; nobody learns from others' rows.

    Args:
        parts: by name, the selector first unless it is ready, then the skills in their order.
        how: how much the task counts, and how far skills may move from their anchors.
    """

    def __init__(self, parts: Mapping[str, Learner], how: Together) -> None:
        self.parts, self._how, self._weight = dict(parts), how, 0.0
        self.counts = {name: [0, 0] for name in parts}
        """By name, in how many rows each has acted, and how often it has learnt from them."""
        self.stacks: Sequence[Stack] = [s for part in parts.values() for s in part.stacks]
        self.overlap = all(part.overlap for part in parts.values())
        self.report_every = max(part.report_every for part in parts.values())
        self.threads = max(part.threads for part in parts.values())

    def request(self, update: int, steps: int, progress: float) -> Request:
        """As many rows as the selector's learner asks for, with the parameters of all.

        Where the selector is ready, as many as the skill asks for that asks for most.
        """
        self._weight = self._how.task_weight * progress
        asked = tuple(p.request(update, steps, progress) for p in self.parts.values())
        if SELECTOR in self.parts:
            return replace(asked[0], parts=asked[1:])
        rows, seeds = max(r.rows for r in asked), asked[0].seeds / SELECTOR
        return Request(rows, (), asked[0].gamma, seeds, parts=asked)

    def take(self, experience: Experience) -> None:
        """Give each its own rows, and skills the task's advantage in them, if it counts."""
        if self._how.task_weight > 0.0:
            advantage = self._weight * self._task_advantage(experience.parts[-1])
            for rows in experience.parts[:-1]:
                rows.advantage = advantage
        own = experience.parts
        if SELECTOR in self.parts:
            own = (replace(experience, parts=()), *own)
        for (name, part), rows in zip(self.parts.items(), own, strict=True):
            self.counts[name][0] += int(
                rows.reward.size if rows.valid is None else rows.valid.sum()
            )
            part.take(rows)

    def _task_advantage(self, rows: Experience) -> Array:
        """What each step did for the task, (T, N) float32, with deviation 1."""
        (stack,) = self.parts[CRITIC].stacks
        store = RolloutStore(1, device=stack.state.params.device)
        store.add(rows)
        rollout = store.rollout(stack.state.gamma)
        assert rollout is not None
        found: Array = stack.algorithm.advantage(stack.state, rollout)[0].cpu().numpy()
        scaled: Array = (found - found.mean()) / (found.std() + np.float32(1e-3))
        return scaled

    def learn(self, update: int, steps: int, progress: float) -> dict[str, Tensor]:
        """Let those learn that have enough rows; metrics under ``<name>.``."""
        found: dict[str, Tensor] = {}
        for name, part in self.parts.items():
            metrics = part.learn(update, steps, progress)
            self.counts[name][1] += bool(metrics)
            found |= prefixed(name, metrics)
        return found

    def cut(self, columns: Array) -> None:
        """The environments of ``columns`` (k,) begin anew."""
        for part in self.parts.values():
            part.cut(columns)

    def kept(self) -> dict[str, Tensor]:
        """What going on exactly needs beside the states of the stacks, at a clean cut."""
        found: dict[str, Tensor] = {}
        for name, part in self.parts.items():
            found |= prefixed(name, part.kept())
        return found

    def load(self, kept: dict[str, Tensor]) -> None:
        """The inverse of ``kept``."""
        for name, part in self.parts.items():
            part.load(unprefixed(name, kept))


def agents_of(stage: StageRun) -> OneAgent:
    """Who learns in a stage where nothing evolves."""
    return WovenAgents(stage) if "together" in stage.entry else OneAgent(stage)


class WovenAgents(OneAgent):
    """A stage's learners where a selector and its skills learn together."""

    stage: Any

    def make_agents(self) -> None:
        """Make who learns; checkpoints hold their states under ``extra``."""
        scene = self.scene
        self.together = Together(**self.stage.entry["together"])
        told = self.stage.entry["algorithms"]
        learns = SELECTOR in self.stage.entry["learns"]
        configs: dict[str, AlgorithmConfig] = {SELECTOR: self.stage.config} if learns else {}
        configs |= {name: config_from_json(told[name]) for name in told}
        spaces = {
            SELECTOR: scene.action_space,
            CRITIC: gym.spaces.Discrete(len(scene.skills.skills)),
        }
        self.algorithms: dict[str, Algorithm] = {
            name: make_algorithm(
                self._as_grown(name, config),
                scene.observation_space,
                spaces.get(name, scene.skill_space),
            )
            for name, config in configs.items()
        }

    def _as_grown(self, name: str, config: Any) -> Any:
        """The settings, with the networks that ``name`` has grown in a population."""
        before = self.stage.policies.get(name)
        if not isinstance(before, AgentPolicy):
            return config
        had: Any = before.algorithm.config
        return replace(
            config, **{k: getattr(had, k) for k in ("network", "critic") if hasattr(had, k)}
        )

    @property
    def scene(self) -> WovenScene:
        """Where they learn."""
        scene: WovenScene = self.stage.scene
        return scene

    def collector(self, num_envs: int, first: int) -> Collector:
        """A collector in which all act."""
        return self.woven(make_engine(self.scene.spec, num_envs, first=first))

    def woven(self, engine: Engine) -> WovenCollector:
        """A collector of these environments in which all act."""
        n = engine.num_envs
        acting = {name: Acting([(a, 1)], n) for name, a in self.algorithms.items()}
        selector, critic = acting.pop(SELECTOR, None), acting.pop(CRITIC, None)
        margin = self.together.margin if self.stage.entry.get("interrupt") else None
        return self.scene.woven(engine, selector, list(acting.values()), critic, margin)

    def learner_from(self, state: None, extra: dict[str, Tensor], log: StageLog) -> Learner:
        """All learners, from a checkpoint, from what they learnt in earlier stages, or fresh."""
        saved, parts = unprefixed("state", extra), dict[str, Learner]()
        for name, algorithm in self.algorithms.items():
            fresh: Any = algorithm.init([self.stage.seeds / name / "member" / 0])
            device = resolve_device(algorithm.config.device)
            before, anchor = self.stage.policies.get(name), None
            if isinstance(before, AgentPolicy):
                fresh = self._as_before(name, algorithm, fresh, before)
                anchor = self._anchor(name, algorithm, fresh, device)
            if saved:
                fresh = state_from(unprefixed(name, saved), fresh, f"{log.run.path}: {name}")
            part = self._part(name, Stack(algorithm, state_to(fresh, device)), log)
            if isinstance(part, RolloutLearner):
                part.anchor = anchor
            if name == SELECTOR:
                keep_to_guide(part, self.stage.entry)
            parts[name] = part
        found = WovenLearner(parts, self.together)
        if extra:
            told = checked_tensor(extra, "counts", (len(parts), 2), torch.int64, str(log.run.path))
            found.counts = dict(zip(parts, told.tolist(), strict=True))
        return found

    def _as_before(self, name: str, algorithm: Algorithm, fresh: Any, before: AgentPolicy) -> Any:
        """The state that ``name`` ended its latest stage with; of a population its weights."""
        found = load_state(self.stage.run, name, fresh)
        if found is None:
            found = fresh
            algorithm.set_weights(found, before.weights)
            found.obs_count.fill_(max(1.0, self._steps_of(name)))
        return found

    def _anchor(
        self, name: str, algorithm: Algorithm, state: Any, device: torch.device
    ) -> Anchor | None:
        """What a skill that was trained before is to stay near: this state."""
        if self.together.anchor_nats is None or name in (SELECTOR, CRITIC):
            return None
        params = algorithm.acting_params(state, device=device)
        return Anchor(params, torch.ones(1, device=device), self.together.anchor_nats)

    def _part(self, name: str, stack: Stack, log: StageLog) -> Learner:
        """The learner of the selector, or of a skill."""
        num_envs, seeds = self.stage.config.num_envs, self.stage.seeds / name
        config = stack.algorithm.config
        if stack.algorithm.store == "rollout":
            rows = num_envs * int(getattr(self.stage.config, "n_steps", config.n_steps))
            whole = name in (SELECTOR, CRITIC)
            quota = 0 if whole else max(1, round(rows * self.together.quota))
            return RolloutLearner(stack, seeds, quota)
        row_steps = self.scene.row_steps if name == SELECTOR else 1
        store = store_of(stack.algorithm, num_envs)
        found = ReplayLearner(
            [stack], store, seeds, row_steps=row_steps, goes_on_at=log.at["steps"]
        )
        if isinstance(self.stage.policies.get(name), AgentPolicy):
            found.act_from_the_start()
        return found

    def _steps_of(self, name: str) -> int:
        """Environment steps that ``name`` has learnt from in earlier stages."""
        stages = self.stage.run.manifest["stages"]
        return sum(s.get("steps", 0) for s in stages if name in s["learns"])

    def train(self, log: StageLog) -> dict[str, AgentPolicy]:
        """Learn until the stage is over; skills that learnt nothing are told."""
        found = super().train(log)
        assert isinstance(self.learner, WovenLearner)
        for name, (rows, updates) in self.learner.counts.items():
            if name in (SELECTOR, CRITIC):
                continue
            if rows and not updates:
                log.tell(
                    f"skill {name!r} acted in {rows:,} of {log.at['steps']:,} steps only, too few "
                    "to learn from once: lower together.quota, raise together.floor, or give more "
                    "steps"
                )
            elif not rows:
                log.tell(
                    f"skill {name!r} was never called in {log.at['steps']:,} steps, so it learnt "
                    "nothing: perhaps its initiation() holds nowhere that the other skills lead "
                    "to, or the selector never chooses it"
                )
        return found

    def policies(self) -> dict[str, AgentPolicy]:
        """By name, who learns, as they are now."""
        stacks = zip(self.algorithms, self.learner.stacks, strict=True)
        return {k: AgentPolicy.of(s.algorithm, state_to(s.state, "cpu")) for k, s in stacks}

    def states(self) -> dict[str, Any]:
        """By name, all that they have learnt."""
        stacks = zip(self.algorithms, self.learner.stacks, strict=True)
        return {name: state_to(stack.state, "cpu") for name, stack in stacks}

    def play(self, arena: Collector, seeds: Seeds) -> Array:
        """An episode in each environment of an arena, (N, 4), by the hierarchy as it is now."""
        player = self.woven(arena.engine)
        requests = {
            name: Request(
                0, (s.algorithm.acting_params(s.state),), s.state.gamma.cpu().numpy(),
                seeds / name, greedy=name == SELECTOR or self.scene.skills.greedy,
            )
            for name, s in zip(self.algorithms, self.learner.stacks, strict=True)
        }  # fmt: skip
        ready = Request(0, (), np.ones(1), seeds / SELECTOR, greedy=True)
        asked = replace(requests.pop(SELECTOR, ready), parts=tuple(requests.values()))
        with torch_threads(1):
            return player.play(asked, seeds / "start", LONGEST_EPISODE)

    def save(self, tick: Tick, log: StageLog) -> None:
        """Write a checkpoint: all states are in ``extra``."""
        assert isinstance(self.learner, WovenLearner)
        states = {"counts": torch.tensor(list(self.learner.counts.values()))}
        for name, state in self.states().items():
            states |= prefixed(f"state.{name}", vars(state))
        log.save(None, (tick.extra or {}) | states)
