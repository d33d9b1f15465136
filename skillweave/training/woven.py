"""A stage in which a selector and its skills learn together, from the same steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.base import Algorithm, state_to
from skillweave.algorithms.config import config_from_json
from skillweave.algorithms.policy import AgentPolicy, make_algorithm, state_from
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
from skillweave.seeding import Seeds
from skillweave.training.episodes import Tick
from skillweave.training.learner import Learner, RolloutLearner, Stack
from skillweave.training.replay_learner import ReplayLearner, store_of
from skillweave.training.scene import WovenScene
from skillweave.training.stage import CRITIC, SELECTOR, Together
from skillweave.training.stage_log import StageLog
from skillweave.training.trainer import OneAgent, StageRun
from skillweave.types import Array, prefixed, unprefixed


class WovenLearner:
    """A selector and skills, each with a learner of its own; nobody learns from others' rows.

    Args:
        parts: by path, the selector first, then all others who learn.
        critic: the path of who tells the task's advantage.
        how: how much the task counts, and how far skills may move from their anchors.
    """

    def __init__(self, parts: Mapping[str, Learner], critic: str, how: Together) -> None:
        self.parts, self._critic, self._how, self._weight = dict(parts), critic, how, 0.0
        self.stacks: Sequence[Stack] = [s for part in parts.values() for s in part.stacks]
        self.overlap = all(part.overlap for part in parts.values())
        self.report_every = max(part.report_every for part in parts.values())
        self.threads = max(part.threads for part in parts.values())

    def request(self, update: int, steps: int, progress: float) -> Request:
        """As many rows as the selector's learner asks for, with the parameters of all."""
        self._weight = self._how.task_weight * progress
        first, *others = (p.request(update, steps, progress) for p in self.parts.values())
        return replace(first, parts=tuple(others))

    def take(self, experience: Experience) -> None:
        """Give each its own rows, and skills the task's advantage in them, if it counts."""
        found = (replace(experience, parts=()), *experience.parts)
        own = dict(zip(self.parts, found, strict=True))
        if self._how.task_weight > 0.0:
            advantage = self._weight * self._task_advantage(own[self._critic])
            for name, rows in own.items():
                if not decides(name):
                    rows.advantage = advantage
        for name, rows in own.items():
            self.parts[name].take(rows)

    def _task_advantage(self, rows: Experience) -> Array:
        """What each step did for the task, (T, N) float32, with deviation 1."""
        (stack,) = self.parts[self._critic].stacks
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
            if isinstance(part, RolloutLearner) and part.anchor and "anchor_kl" in metrics:
                part.anchor.coef = adapted(
                    part.anchor.coef, metrics["anchor_kl"], self._how.anchor_nats
                )
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
            if isinstance(part, RolloutLearner) and part.anchor:
                found[f"{name}.anchor_coef"] = part.anchor.coef.clone()
        return found

    def load(self, kept: dict[str, Tensor]) -> None:
        """The inverse of ``kept``."""
        for name, part in self.parts.items():
            own = unprefixed(name, kept)
            coef = own.pop("anchor_coef", None)
            if isinstance(part, RolloutLearner) and part.anchor and coef is not None:
                if coef.shape != (1,) or not bool(coef.isfinite().all()):
                    raise ValueError(f"the price of divergence of {name} is {coef.tolist()}")
                part.anchor.coef = coef.to(part.anchor.coef.device)
            part.load(own)


def decides(path: str) -> bool:
    """Whether it is the path of a selector or a critic of skills: they are no skills."""
    return path.rpartition("/")[2] in (SELECTOR, CRITIC)


def adapted(coef: Tensor, kl: Tensor, nats: float | None) -> Tensor:
    """What a nat of KL costs from now on, so that KL comes near ``nats``; (P,) each.

    The rule of the adaptive penalty of Schulman et al. 2017, sec. 4.
    """
    nats = nats or 0.0
    factor = torch.where(kl > 1.5 * nats, 2.0, torch.where(kl < nats / 1.5, 0.5, 1.0))
    return (coef * factor).clamp(1e-3, 1e3)


def agents_of(stage: StageRun) -> OneAgent:
    """Who learns in a stage where nothing evolves."""
    return WovenAgents(stage) if "together" in stage.entry else OneAgent(stage)


class WovenAgents(OneAgent):
    """A stage's learners where a selector and its skills learn together."""

    stage: Any

    def make_agents(self) -> None:
        """Make who learns; checkpoints hold their states under ``extra``."""
        entry, scene = self.stage.entry, self.scene
        self.together = Together(**entry["together"])
        self.first: str = entry["learns"][0]
        self.node = self.first.removesuffix(SELECTOR)
        told = {name: config_from_json(own) for name, own in entry["algorithms"].items()}
        self.algorithms: dict[str, Algorithm] = {
            name: make_algorithm(
                self._as_grown(name, config),
                scene.observation_space,
                scene.chooses_from(self._below(name)),
            )
            for name, config in ({self.first: self.stage.config} | told).items()
        }

    def _below(self, path: str) -> str:
        """A path as it is in the hierarchy that this stage is of."""
        return path.removeprefix(self.node)

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
        acting = {self._below(k): Acting([(a, 1)], n) for k, a in self.algorithms.items()}
        selector = acting.pop(SELECTOR)
        return self.scene.woven(engine, selector, acting, self._margins())

    def _margins(self) -> dict[str, float]:
        """By the paths of critics, where calls are cut."""
        own = {CRITIC: self.together.margin} if self.stage.entry.get("interrupt") else {}
        return own | dict(self.scene.margins)

    def learner_from(self, state: None, extra: dict[str, Tensor], log: StageLog) -> Learner:
        """All learners, from a checkpoint, from what they learnt in earlier stages, or fresh."""
        saved, parts = unprefixed("state", extra), dict[str, Learner]()
        for name, algorithm in self.algorithms.items():
            fresh: Any = algorithm.init([self.stage.seeds / name / "member" / 0])
            device = resolve_device(algorithm.config.device)
            before, anchor = self.stage.policies.get(name), None
            if isinstance(before, AgentPolicy):
                algorithm.set_weights(fresh, before.weights)
                fresh.obs_count.fill_(max(1.0, self._steps_of(name)))
                anchor = self._anchor(name, algorithm, fresh, device)
            if saved:
                fresh = state_from(unprefixed(name, saved), fresh, f"{log.run.path}: {name}")
            part = self._part(name, Stack(algorithm, state_to(fresh, device)), log)
            if isinstance(part, RolloutLearner):
                part.anchor = anchor
            parts[name] = part
        return WovenLearner(parts, self.node + CRITIC, self.together)

    def _anchor(
        self, name: str, algorithm: Algorithm, state: Any, device: torch.device
    ) -> Anchor | None:
        """What a skill that was trained before is to stay near: this state."""
        near = self.together.anchor_nats is not None and not decides(name)
        if not near or algorithm.memory_size:  # what an anchor would remember is not known
            return None
        params = algorithm.acting_params(state, device=device)
        return Anchor(params, torch.ones(1, device=device))

    def _part(self, name: str, stack: Stack, log: StageLog) -> Learner:
        """The learner of the selector, or of a skill."""
        num_envs, seeds = self.stage.config.num_envs, self.stage.seeds / name
        config, row_steps = stack.algorithm.config, self.scene.steps_of_row(self._below(name))
        if stack.algorithm.store == "rollout":
            rows = num_envs * int(getattr(self.stage.config, "n_steps", config.n_steps))
            whole = self._below(name) in (SELECTOR, CRITIC)
            quota = 0 if whole else max(1, round(rows * self.together.quota / row_steps))
            return RolloutLearner(stack, seeds, quota)
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

    def policies(self) -> dict[str, AgentPolicy]:
        """By name, who learns, as they are now."""
        stacks = zip(self.algorithms, self.learner.stacks, strict=True)
        return {k: AgentPolicy.of(s.algorithm, state_to(s.state, "cpu")) for k, s in stacks}

    def play(self, arena: Collector, seeds: Seeds) -> Array:
        """An episode in each environment of an arena, (N, 4), by the hierarchy as it is now."""
        player = self.woven(arena.engine)
        requests = [
            Request(
                0, (s.algorithm.acting_params(s.state),), s.state.gamma.cpu().numpy(),
                seeds / name, greedy=self.scene.is_greedy(self._below(name)),
            )
            for name, s in zip(self.algorithms, self.learner.stacks, strict=True)
        ]  # fmt: skip
        asked = replace(requests[0], parts=tuple(requests[1:]))
        with torch_threads(1):
            return player.play(asked, seeds / "start", LONGEST_EPISODE)

    def save(self, tick: Tick, log: StageLog) -> None:
        """Write a checkpoint: all states are in ``extra``."""
        states: dict[str, Tensor] = {}
        for name, stack in zip(self.algorithms, self.learner.stacks, strict=True):
            own = vars(state_to(stack.state, "cpu"))
            states |= prefixed(f"state.{name}", own)
        log.save(None, (tick.extra or {}) | states)
