"""A stage in which a selector and its skills learn together, from the same steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.base import Algorithm, state_to
from skillweave.algorithms.config import config_from_json
from skillweave.algorithms.policy import AgentPolicy, checked_tensor, make_algorithm, state_from
from skillweave.collecting.acting import Acting, Request
from skillweave.collecting.collector import Collector
from skillweave.collecting.group import MakeCollector
from skillweave.collecting.where import MakeCollectors, make_collectors
from skillweave.collecting.woven import WovenCollector
from skillweave.envs.checks import longest_evaluation
from skillweave.envs.engine import Engine
from skillweave.envs.make import make_engine
from skillweave.errors import RunError
from skillweave.experience import Reference
from skillweave.ops.device import INT, resolve_device
from skillweave.ops.threads import torch_threads
from skillweave.runs.starts import start_of
from skillweave.runs.states import load_state, state_path
from skillweave.seeding import Seeds, global_generators
from skillweave.training.learner import Learner, RolloutLearner, Stack, keep_to_guide
from skillweave.training.replay_learner import ReplayLearner, store_of
from skillweave.training.scene import WovenScene
from skillweave.training.stage import CRITIC, SELECTOR, Together, decides
from skillweave.training.stage_log import StageLog, success_rate
from skillweave.training.stage_run import StageRun, begin_as
from skillweave.training.trainer import OneAgent
from skillweave.training.woven_learner import WovenLearner
from skillweave.types import Array, prefixed, unprefixed


def agents_of(stage: StageRun, make_collectors: MakeCollectors = make_collectors) -> OneAgent:
    """Who learns in a stage where nothing evolves, from collectors that are made so."""
    kind = WovenAgents if "together" in stage.entry else OneAgent
    return kind(stage, make_collectors)


class WovenAgents(OneAgent):
    """A stage's learners where a selector and its skills learn together."""

    stage: Any

    def make_agents(self) -> None:
        """Make who learns; checkpoints hold their states under ``extra``."""
        entry, scene = self.stage.entry, self.scene
        self.together = Together(**entry["together"])
        self.first: str = entry["decides"]
        self.node = self.first.removesuffix(SELECTOR)
        configs = {self.first: self.stage.config} if self.first in entry["learns"] else {}
        configs |= {name: config_from_json(own) for name, own in entry["algorithms"].items()}
        self.algorithms: dict[str, Algorithm] = {}
        for name, config in configs.items():
            grown, acts = self._as_grown(name, config), scene.chooses_from(self._below(name))
            self.algorithms[name] = self._made(grown, acts) or make_algorithm(
                grown, scene.observation_space, acts
            )

    def _made(self, config: Any, action_space: Any) -> Algorithm | None:
        """One that is there already: it need not be compiled again.

        An algorithm holds nothing that is learnt, so several learners may have the same one.
        """
        for other in self.algorithms.values():
            if other.config == config and other.action_space == action_space:
                return other
        return None

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

    def maker(self) -> MakeCollector:
        """What makes collectors in which all act; it may be sent to other machines."""
        return partial(_collector, self.scene, self._acting(), self._margins())

    def _acting(self) -> dict[str, Algorithm]:
        """Who acts, by their paths in the hierarchy that this stage is of."""
        return {self._below(k): a for k, a in self.algorithms.items()}

    def _margins(self) -> dict[str, float]:
        """By the paths of critics, where calls are cut."""
        own = {CRITIC: self.together.margin} if self.together.interrupt else {}
        return own | dict(self.scene.margins)

    def _guide_kl(self, name: str) -> float | None:
        """Return the KL within which a learner stays of its guide; None: without limit."""
        if name == self.first:
            kl: float | None = self.stage.entry.get("guide_kl")
            return kl
        return self.scene.guide_kl.get(self._below(name))

    def learner_from(self, state: None, extra: dict[str, Tensor], log: StageLog) -> Learner:
        """All learners, from a checkpoint, from what they learnt in earlier stages, or fresh."""
        saved, parts = unprefixed("state", extra), dict[str, Learner]()
        for name, algorithm in self.algorithms.items():
            fresh: Any = algorithm.init([self.stage.seeds / name / "member" / 0])
            device = resolve_device(algorithm.config.device)
            before, reference = self._before(name), None
            if before is not None:
                if not saved:
                    self._tell_lost_state(name, log)
                fresh = self._as_before(name, algorithm, fresh, *before)
                reference = self._reference(name, algorithm, fresh, device, log)
            if saved:
                fresh = state_from(unprefixed(name, saved), fresh, f"{log.run.path}: {name}")
            stack = Stack(algorithm, state_to(fresh, device))
            learnt_before = before is not None or name in self.stage.entry.get("starts", {})
            part = self._part(name, stack, log, learnt_before=learnt_before)
            if reference is not None:
                part.reference = reference  # type: ignore[attr-defined]
            keep_to_guide(part, self._guide_kl(name))
            parts[name] = part
        weights = self.stage.entry["task_weights"]
        found = WovenLearner(parts, self.node, self.together.task_weight, weights)
        if extra:
            told = checked_tensor(extra, "counts", (len(parts), 2), torch.int64, str(log.run.path))
            if not ((told >= 0) & (told < 2**53)).all():
                raise RunError(f"{log.run.path}: its counts of rows and updates are out of range")
            found.counts = dict(zip(parts, told.tolist(), strict=True))
        return found

    def _before(self, name: str) -> tuple[AgentPolicy, int] | None:
        """What ``name`` has learnt before: in earlier stages, or in the run that it starts from.

        Beside the policy, from how many steps it learnt.
        """
        found = self.stage.policies.get(name)
        if isinstance(found, AgentPolicy):
            return found, self._steps_of(name)
        if self.stage.continues:
            return None  # all is in its final state
        return start_of(self.stage.run, self.stage.name, name, self.algorithms[name])

    def _tell_lost_state(self, name: str, log: StageLog) -> None:
        """Say so where the file of a state was deleted."""
        latest, path = self._latest_stage(name), state_path(self.stage.run, name)
        kept = latest.get("kept", {}).get("kept")
        if latest and latest.get("evolution") is None and kept != "before" and not path.exists():
            log.tell(
                f"{path} is not there any more, so {name!r} goes on with its weights alone, and "
                "learns otherwise than without the interruption"
            )

    def _as_before(
        self, name: str, algorithm: Algorithm, fresh: Any, policy: AgentPolicy, steps: int
    ) -> Any:
        """The state that ``name`` ended its latest stage with; else its weights alone."""
        found = load_state(self.stage.run, name, fresh)
        if found is None:
            begin_as(algorithm, fresh, policy, steps)
            found = fresh
        return found

    def _reference(
        self, name: str, algorithm: Algorithm, state: Any, device: torch.device, log: StageLog
    ) -> Reference | None:
        """What a skill that was trained before is to stay near: this state."""
        rollouts = algorithm.store == "rollout"
        if self.together.reference_kl is None or decides(name) or not rollouts:
            return None
        if not self._stages_of(name):
            return None  # it starts from another run, to learn what this one asks for
        rate = success_rate(self._latest_stage(name))
        if rate == 0.0:
            log.tell(
                f"skill {name!r} did not succeed any more when its own stage ended, so it moves "
                "freely here (together.reference_kl is not used for it)"
            )
            return None
        params = algorithm.acting_params(state, device=device)
        # Who seldom succeeded has little to lose, and much to learn.
        return Reference(
            params,
            torch.ones(1, dtype=torch.float32, device=device),
            self.together.reference_kl / rate,
        )

    def _part(self, name: str, stack: Stack, log: StageLog, *, learnt_before: bool) -> Learner:
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
        if learnt_before:
            found.act_from_the_start()
        return found

    def _stages_of(self, name: str) -> list[dict[str, Any]]:
        """The stages before in which ``name`` has learnt."""
        stages = self.stage.run.manifest["stages"]
        return [s for s in stages if name in s["learns"] and s["status"] == "done"]

    def _latest_stage(self, name: str) -> dict[str, Any]:
        """The latest of them; empty where there is none."""
        return next(reversed(self._stages_of(name)), {})

    def _steps_of(self, name: str) -> int:
        """Environment steps that ``name`` has learnt from in earlier stages."""
        return sum(s.get("steps", 0) for s in self._stages_of(name))

    def train(self, log: StageLog) -> dict[str, AgentPolicy]:
        """Learn until the stage is over; skills that learnt nothing are told."""
        found = super().train(log)
        assert isinstance(self.learner, WovenLearner)
        for name, (rows, updates) in self.learner.counts.items():
            if decides(name):
                continue
            if rows and not updates:
                log.tell(
                    f"skill {name!r} acted in {rows:,} of {log.at['steps']:,} steps only, too few "
                    "to learn from once: lower together.quota, raise together.epsilon, or give "
                    "more steps"
                )
            elif not rows:
                log.tell(
                    f"skill {name!r} was never called in {log.at['steps']:,} steps, so it learnt "
                    "nothing: perhaps its initiation() holds nowhere that the other skills lead "
                    "to, or the selector never chooses it"
                )
        return found

    def tell_early(self, steps: int, log: StageLog) -> None:
        """Name skills that were not called so far."""
        assert isinstance(self.learner, WovenLearner)
        for name, (rows, _) in self.learner.counts.items():
            if not rows and not decides(name):
                log.tell(
                    f"skill {name!r} was not called in the first {steps:,} steps; it begins to "
                    "learn once its initiation() is True where other skills end"
                )

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
        player = _woven(self.scene, self._acting(), self._margins(), arena.engine)
        requests = {
            name: Request(
                0, (s.algorithm.acting_params(s.state),), s.state.gamma.cpu().numpy(),
                seeds / name, greedy=self.scene.is_greedy(self._below(name)),
            )
            for name, s in zip(self.algorithms, self.learner.stacks, strict=True)
        }  # fmt: skip
        ready = Request(0, (), np.ones(1), seeds / self.first, greedy=True)
        asked = replace(
            requests.pop(self.first, ready), below={self._below(k): r for k, r in requests.items()}
        )
        with torch_threads(1), global_generators(seeds / "global"):
            limit = longest_evaluation(arena.engine.time_limit)
            return player.play(asked, seeds / "start", limit)

    def saved(self, extra: dict[str, Tensor]) -> tuple[None, dict[str, Tensor]]:
        """Return all states among the extra tensors."""
        assert isinstance(self.learner, WovenLearner)
        states = {"counts": torch.tensor(list(self.learner.counts.values()), **INT)}
        for name, state in self.states().items():
            states |= prefixed(f"state.{name}", vars(state))
        return None, extra | states | self.best_tensors()


def _collector(
    scene: WovenScene,
    algorithms: Mapping[str, Algorithm],
    margins: Mapping[str, float],
    num_envs: int,
    first: int,
) -> Collector:
    found = _woven(scene, algorithms, margins, make_engine(scene.spec, num_envs, first=first))
    found.log_info = scene.log_info
    return found


def _woven(
    scene: WovenScene,
    algorithms: Mapping[str, Algorithm],
    margins: Mapping[str, float],
    engine: Engine,
) -> WovenCollector:
    """A collector of these environments in which all act."""
    acting = {k: Acting([(a, 1)], engine.num_envs) for k, a in algorithms.items()}
    selector = acting.pop(SELECTOR, None)
    return scene.woven(engine, selector, acting, margins)
