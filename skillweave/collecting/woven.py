"""The collector of a hierarchy whose skills learn where they are called."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from skillweave.collecting.acting import Acted, Acting, Request
from skillweave.collecting.calls import Interruption, SkillSet, Why, skill_step
from skillweave.collecting.columns import stacked
from skillweave.collecting.decisions import DecisionCollector
from skillweave.collecting.guide import Guide
from skillweave.envs.engine import Engine
from skillweave.experience import Experience
from skillweave.skills import apply_reflexes, asked
from skillweave.spaces import action_codec
from skillweave.types import Array, Memory, Memoryless, SkillweaveError, Step


class LearningSkill(Memoryless):
    """A skill that learns, as a policy of a ``SkillSet``; what it did last is kept.

    Args:
        acting: its learner, one member.
    """

    def __init__(self, acting: Acting) -> None:
        ((algorithm, _),) = acting.stacks
        self.acts, self.observation_space = acting, algorithm.observation_space
        self.action_space = algorithm.action_space
        self.acted: Acted | None = None
        """What it did in the latest step, in the environments where it was called."""

    def start(self, n: int) -> Memory:
        """Zeros, (n, M), where the network has a memory."""
        size = self.acts.memory_size
        return {"rnn": np.zeros((n, size), np.float32)} if size else {}

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Actions (n, …) in the environment's units, as the request says."""
        self.acted = self.acts.these(obs, mask, memory.get("rnn"))
        after = {} if self.acted.memory is None else {"rnn": self.acted.memory}
        return self.acts.to_env(self.acted.action), after


class WovenCollector(DecisionCollector):
    """N environments in which a selector calls skills, and all learn from the same steps.

    A row is the skill's that acted in it, judged by its own reward and its own end. A trajectory of
    a skill goes on from call to call, where it is called again at once after a limit; elsewhere the
    end of a call cuts it, and its value goes on.

    Args:
        engine: the environments.
        acting: the selector.
        skills: those that learn have any policy.
        learners: by its number, each skill that learns.
        critic: of skills; None: nobody asks what they are worth.
        margin: calls are cut where the critic says that another skill is worth so much more; None:
            they are not.
        guide: a ready selector that is asked wherever the selector decides.
    """

    def __init__(
        self,
        engine: Engine,
        acting: Acting | None,
        skills: SkillSet,
        learners: Mapping[int, Acting],
        critic: Acting | None = None,
        margin: float | None = None,
        guide: Guide | None = None,
    ) -> None:
        self.learners = {i: LearningSkill(a) for i, a in learners.items()}
        self.critic = critic
        policies = [self.learners.get(i, p) for i, p in enumerate(skills.policies)]
        cuts = None if margin is None else Interruption(self._worth, margin)
        self.reflexes, self._overridden = skills.reflexes, np.zeros(engine.num_envs, bool)
        skills = replace(skills, policies=tuple(policies), interruption=cuts, reflexes=())
        super().__init__(engine, acting, skills, guide=guide)
        self._watches = True
        self.kept["fresh"] = np.zeros(self.num_envs, bool)  # the skill that acts begins to
        self._rows: Rows | None = None

    def like(self, engine: Engine, acting: Acting) -> Any:
        """Not possible: populations of hierarchies that learn as a whole are not built."""
        raise SkillweaveError("hierarchies that learn as a whole do not evolve")

    def _collect(self, request: Request) -> Experience:
        self._rows = Rows(self, request.rows)
        found = super()._collect(request)
        found.parts = self._rows.experiences()
        self._rows = None
        return found

    def _prepare(self, request: Request) -> None:
        super()._prepare(request)
        others = [skill.acts for skill in self.learners.values()]
        others += [] if self.critic is None else [self.critic]
        for acting, own in zip(others, request.parts, strict=True):
            acting.begin(own, every_step=False)

    def _worth(self, obs: Array) -> Array:
        """What each skill is worth in observations (n, …), (n, S)."""
        assert self.critic is not None
        worth = self.critic.these(obs, None, None).head
        assert worth is not None
        return worth

    def _act(self, obs: Array, mask: Array | None) -> Array:
        action = super()._act(obs, mask)
        if self.reflexes:
            space = self.engine.action_space
            action, self._overridden = apply_reflexes(self.reflexes, obs, action, space)
        return action

    def _decide(self, rows: Array) -> None:
        """The selector chooses; a skill that is called again at once goes on."""
        before = self._calls["skill"][rows]
        super()._decide(rows)
        same = before == self._calls["skill"][rows]
        self.kept["fresh"][rows] = ~same
        if self._rows is not None:
            self._rows.go_on(rows[same])

    def _record(self, step: Step, mask: Array | None, why: Array) -> None:
        """Keep the step for the skills that learn."""
        assert self._rows is not None
        self._rows.put(step, mask, self.engine.mask())
        for i, skill in self.learners.items():
            mine = np.flatnonzero(self._calls["skill"] == i)
            if len(mine):
                self._judge(i, mine, step, why[mine])
                assert skill.acted is not None
                self._rows.put_skill(i, mine, skill.acted)
        self._rows.next()
        self.kept["fresh"][:] = False

    def _judge(self, i: int, mine: Array, step: Step, why: Array) -> None:
        """What a step was to skill ``i``, in environments ``mine`` (k,)."""
        assert self._rows is not None
        skill, elapsed = self.skills.skills[i], self._calls["elapsed"][mine]
        part = skill_step(step, mine, elapsed, skill.max_steps)
        reward = asked(skill, "reward", part, len(mine), elapsed, mine)
        terminated = part.terminated.copy()
        terminated[why == Why.OWN] = True
        if skill.defines("termination"):  # an episode's last step may be its own end, too
            last = np.flatnonzero((why == Why.EPISODE) & ~terminated)
            if len(last):
                own = skill_step(step, mine[last], elapsed[last], skill.max_steps)
                ends = asked(skill, "termination", own, len(last), elapsed[last], mine[last])
                terminated[last] |= ends
        over = (why != Why.RUNNING) & ~terminated
        goes_on = over & (why != Why.EPISODE) & ~part.timed_out
        self._rows.judge(mine, reward, terminated, over, goes_on)


class Rows:
    """T rows of N columns, one for each step, shared by all skills that learn."""

    def __init__(self, collector: WovenCollector, rows: int) -> None:
        n, obs = collector.num_envs, collector.obs
        lead, self._at, self._collector = (rows, n), 0, collector
        self._obs = np.empty((rows, *obs.shape), obs.dtype)
        self._next_obs = np.empty_like(self._obs)
        self._reward = np.zeros(lead, np.float32)
        self._task = np.empty(lead, np.float32)
        self._terminated, self._truncated = np.zeros(lead, bool), np.zeros(lead, bool)
        self._owner = np.empty(lead, np.int64)
        self._fresh = np.empty(lead, bool)
        self._ended, self._cut = np.empty(lead, bool), np.empty(lead, bool)  # the episode
        self._overridden = np.zeros(lead, bool) if collector.reflexes else None
        self._goes_on = np.zeros(n, bool)  # if the same skill is called again
        self._masks: list[Array | None] = []
        self._next_masks: list[Array | None] = []
        self._heads: dict[int, Array] = {}
        self._memory: dict[int, Array] = {}
        for i, skill in collector.learners.items():
            if skill.acts.memory_size:
                self._memory[i] = collector._calls[f"{i}.rnn"].copy()
        codec = action_codec(collector.engine.action_space)  # all skills act in this space
        units = codec.from_env(np.asarray(codec.space.sample())[None])
        self._action = np.zeros((*lead, *units.shape[1:]), units.dtype)

    def go_on(self, ids: Array) -> None:
        """In environments ``ids`` (k,) the skill that acted last is called again."""
        if self._at:
            on = ids[self._goes_on[ids]]
            self._truncated[self._at - 1, on] = False

    def put(self, step: Step, mask: Array | None, next_mask: Array | None) -> None:
        """Write what happened in the environments."""
        at, collector = self._at, self._collector
        self._obs[at], self._next_obs[at], self._task[at] = step.obs, step.next_obs, step.reward
        self._owner[at], self._fresh[at] = collector._calls["skill"], collector.kept["fresh"]
        self._ended[at], self._cut[at] = step.terminated, step.truncated
        if self._overridden is not None:
            self._overridden[at] = collector._overridden
        self._masks.append(mask)
        self._next_masks.append(next_mask)
        self._goes_on[:] = False

    def put_skill(self, i: int, mine: Array, acted: Acted) -> None:
        """Write what skill ``i`` did in environments ``mine`` (k,)."""
        lead = self._reward.shape
        self._action[self._at, mine] = acted.action
        if acted.head is not None:
            if i not in self._heads:
                self._heads[i] = np.zeros((*lead, *acted.head.shape[1:]), acted.head.dtype)
            self._heads[i][self._at, mine] = acted.head

    def judge(
        self, mine: Array, reward: Array, terminated: Array, over: Array, goes_on: Array
    ) -> None:
        """Write what the step was to the skill of environments ``mine`` (k,)."""
        at = self._at
        self._reward[at, mine], self._terminated[at, mine] = reward, terminated
        self._truncated[at, mine], self._goes_on[mine] = over, goes_on

    def next(self) -> None:
        """The row is full."""
        self._at += 1

    def experiences(self) -> tuple[Experience, ...]:
        """What each skill that learns did, in the order of the skills; then all for the critic."""
        mask, next_mask = stacked(self._masks), stacked(self._next_masks)
        steps = np.ones(self._reward.shape, np.int64)
        found = []
        for i in self._collector.learners:
            memory = self._memory.get(i)
            found.append(
                Experience(
                    obs=self._obs, action=self._action, reward=self._reward, steps=steps,
                    terminated=self._terminated, truncated=self._truncated,
                    next_obs=self._next_obs, obs_mask=mask, next_obs_mask=next_mask,
                    valid=self._owner == i, head=self._heads.get(i), memory=memory,
                    starts=None if memory is None else self._fresh, overridden=self._overridden,
                )
            )  # fmt: skip
        if self._collector.critic is not None:
            found.append(
                Experience(
                    obs=self._obs, action=self._owner, reward=self._task, steps=steps,
                    terminated=self._ended, truncated=self._cut & ~self._ended,
                    next_obs=self._next_obs,
                )
            )  # fmt: skip
        return tuple(found)
