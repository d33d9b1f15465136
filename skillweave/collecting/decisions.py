"""The collector of a selector: a row is a decision, and the whole call that followed it.

No environment waits for another: where a call is over, the selector decides anew, while the other
calls go on. A call that is under way when the rows are full goes on in the next experience.
"""

from __future__ import annotations

import numpy as np

from skillweave.collecting.acting import Acting, Request
from skillweave.collecting.calls import SkillSet, Why
from skillweave.collecting.collector import Collector
from skillweave.collecting.columns import as_wide
from skillweave.collecting.guide import Guide, as_logits, tell_guide
from skillweave.envs.checks import LONGEST_EPISODE
from skillweave.envs.engine import Engine, RawStep
from skillweave.envs.infos import told_success
from skillweave.experience import Experience
from skillweave.types import Array, Memory, SkillweaveError, Step, prefixed


class DecisionCollector(Collector):
    """N environments in which a selector decides which skill is called.

    The reward of a decision is Σ γᵏ rₖ over its call, to be discounted by γ^τ afterwards (Sutton,
    Precup & Singh 1999, sec. 3).

    Args:
        engine: the environments.
        acting: the selectors that learn.
        skills: what their actions mean.
        keep_rewards: of each call, keep the reward of every step, so that others may learn from it
            with a γ of their own.
        guide: a ready selector that is asked wherever they decide.
    """

    def __init__(
        self,
        engine: Engine,
        acting: Acting | None,
        skills: SkillSet,
        keep_rewards: bool = False,
        guide: Guide | None = None,
    ) -> None:
        super().__init__(engine, acting)
        n, count = self.num_envs, skills.choices
        self.skills, self.keep_rewards = skills, keep_rewards
        self.guide = guide
        self._watches = skills.watches or guide is not None
        self._calls: Memory = skills.start(n)  # what the skills remember of each environment
        self._never = np.zeros(n, bool)
        self.kept |= prefixed("skills", self._calls) | {
            "over": np.zeros(n, bool),  # there is no call: the selector must decide
            "first": np.zeros(n, bool),  # the open call is the episode's first
            "reward": np.zeros(n),  # Σ γᵏ rₖ of the open call
            "discount": np.zeros(n),  # γ^τ
            "tau": np.zeros(n, np.int64),
            "choice": np.zeros(n, np.int64),
            "before": np.zeros_like(self.kept["memory"]),  # the selector's, when it decided
        }
        self._restricts = guide is not None or any(s.defines("initiation") for s in skills.skills)
        if guide is not None:
            self.kept |= guide.start(n)
            self.kept["chances"] = np.zeros((n, count), np.float32)  # of its choices, when asked
        if self._restricts:
            self.kept["allowed"] = np.ones((n, count), bool)  # when it decided

    def like(self, engine: Engine, acting: Acting) -> DecisionCollector:
        """The same over other environments."""
        return DecisionCollector(engine, acting, self.skills, self.keep_rewards, self.guide)

    def _forget(self, ids: Array) -> None:
        super()._forget(ids)
        self.skills.forget(self._calls, ids)
        self.kept["over"][ids] = True
        self.kept["first"][ids] = True
        if self.guide is not None:
            for name, value in self.guide.start(len(ids)).items():
                self.kept[name][ids] = value

    def _collect(self, request: Request) -> Experience:
        self._prepare(request)
        out = Decisions(self.num_envs)
        for _ in range(request.rows):
            self._step(out)
        self._check_lengths()
        return out.experience(self)

    def _prepare(self, request: Request) -> None:
        self.acting.begin(request, every_step=False)
        self._gamma = request.gamma.astype(np.float64).repeat(self.acting.each)
        self._rng, self._greedy = (request.seeds / "skills").numpy(), request.greedy

    def _step(self, out: Decisions | None = None) -> None:
        """One step of every environment."""
        rows = np.flatnonzero(self.kept["over"])
        if len(rows):
            self._decide(rows)
        obs, mask = self.obs, self.engine.mask()
        action = self._act(obs, mask)
        raw = self.engine.step(action)
        self._count(raw)
        ended = raw.terminated | raw.truncated
        seen = self._seen(obs, action, raw) if self._watches else None
        why = self.skills.observe(self._calls, self._all, seen)
        why[ended] = Why.EPISODE
        if self.guide is not None and seen is not None:
            tell_guide(self.guide, self.kept, self.skills, self._calls, seen, why)
        if out is not None and seen is not None:
            self._record(seen, mask, why)
        self.obs = raw.next_obs
        ids = np.flatnonzero(why != Why.RUNNING)
        if len(ids):
            self.kept["over"][ids] = True
            if out is not None:
                out.put(ids, self, raw)
            self.kept["first"][ids] = False
            if ended.any():
                ids = np.flatnonzero(ended)
                success = told_success(raw.info, self.num_envs)
                self._tell(ids, None if success is None else success[ids])
                self._begin_anew(ids)

    def _act(self, obs: Array, mask: Array | None) -> Array:
        """What the running skills do, with the reflexes in force."""
        return self.skills.act(self._calls, self._all, obs, self._rng, mask)

    def _seen(self, obs: Array, action: Array, raw: RawStep) -> Step:
        """The step as skills are shown it."""
        return Step(
            obs, action, raw.next_obs, raw.reward, raw.terminated, raw.truncated,
            self._never, self._calls["elapsed"], raw.info,
        )  # fmt: skip

    def _record(self, step: Step, mask: Array | None, why: Array) -> None:
        """Keep the step for skills that learn; here they do not."""

    def _decide(self, rows: Array) -> None:
        """The selector chooses a skill in environments ``rows`` (k,), and its call begins."""
        kept, here = self.kept, self.obs[rows]
        allowed = None
        if self._restricts:
            kept["allowed"][rows] = self._allowed(rows, here)
            allowed = kept["allowed"]
        acted = self.acting.some(rows, self.obs, allowed, self.memory)
        choice = np.asarray(self.acting.to_env(acted.action))
        kept["choice"][rows] = choice
        kept["reward"][rows], kept["discount"][rows], kept["tau"][rows] = 0.0, 1.0, 0
        kept["before"][rows], kept["over"][rows] = kept["memory"][rows], False
        if "rewards" in self.open:
            self.open["rewards"][rows] = 0.0
        if acted.memory is not None:
            kept["memory"][rows] = acted.memory
        for name, value in (("obs", here), ("head", acted.head)):
            if value is not None:
                held = self.open.get(name)
                if held is None or held.shape[1:] != value.shape[1:]:
                    self.open[name] = np.zeros((self.num_envs, *value.shape[1:]), value.dtype)
                self.open[name][rows] = value
        self.skills.begin(self._calls, rows, choice)

    def _allowed(self, rows: Array, here: Array) -> Array:
        """Choices that are allowed in environments ``rows`` (k,), in observations ``here``."""
        may = self.skills.mask(here, self.kept["age"][rows])
        if self.guide is None:
            assert may is not None
            return may
        may = self.skills.startable(here) if may is None else may
        return self.guide.mask(self.kept, rows, here, may, self._greedy, self._rng)

    def _count(self, raw: RawStep) -> None:
        """Add a step to the open calls and episodes."""
        kept = self.kept
        if self.keep_rewards:
            self._keep(raw.reward)
        kept["reward"] += kept["discount"] * raw.reward
        kept["discount"] *= self._gamma
        kept["tau"] += 1
        kept["age"] += 1
        kept["sums"][:, 0] += raw.reward
        kept["sums"][:, 2] += 1

    def _keep(self, reward: Array) -> None:
        """Keep the reward of this step of the open calls."""
        longest = int(self.kept["tau"].max()) + 1
        rewards = self.open.setdefault("rewards", np.zeros((self.num_envs, 16), np.float32))
        if longest > rewards.shape[1]:
            rewards = np.pad(rewards, ((0, 0), (0, longest)))
            self.open["rewards"] = rewards
        rewards[self._all, self.kept["tau"]] = reward

    def _check_lengths(self) -> None:
        """Raise a SkillweaveError where a call has run for so long that nothing seems to end it."""
        steps = self.kept["tau"]
        if steps.max() >= LONGEST_EPISODE:
            row = int(steps.argmax())
            name = self.skills.skills[int(self._calls["skill"][row])].name
            raise SkillweaveError(
                f"skill {name!r} has run for {int(steps[row]):,} steps in environment {row}, and "
                "neither its termination() nor the episode's end has come: give it max_steps, or "
                "the hierarchy call_steps"
            )


class Decisions:
    """Decisions as their calls end: some columns have more of them than others."""

    def __init__(self, num_envs: int) -> None:
        self._count = np.zeros(num_envs, np.int64)
        self._found: list[tuple[Array, Array, dict[str, Array]]] = []

    def put(self, ids: Array, collector: DecisionCollector, raw: RawStep) -> None:
        """The calls of environments ``ids`` (k,) are over."""
        kept, opened = collector.kept, collector.open
        values = {
            "obs": opened["obs"][ids],
            "action": kept["choice"][ids],
            "reward": (kept["reward"][ids] - collector.skills.call_cost).astype(np.float32),
            "steps": kept["tau"][ids],
            "terminated": raw.terminated[ids],
            "truncated": raw.truncated[ids],
            "next_obs": raw.next_obs[ids],
            "starts": kept["first"][ids],
        }
        if collector.acting.memory_size:
            values["memory"] = kept["before"][ids]
        if "head" in opened:
            values["head"] = opened["head"][ids]
        if "allowed" in kept:
            values["obs_mask"] = kept["allowed"][ids]
            values["next_obs_mask"] = self._next_mask(collector, values, ids)
        if collector.guide is not None and collector.guide.tells:
            values["guide"] = as_logits(kept["chances"][ids], values["obs_mask"])
        if "rewards" in opened:
            values["rewards"] = opened["rewards"][ids]
        self._found.append((self._count[ids], ids, values))
        self._count[ids] += 1

    def experience(self, collector: DecisionCollector) -> Experience:
        """All decisions, (D, N), as far as each column goes."""
        if not self._found:
            return self._nothing(collector)
        height = int(self._count.max())
        n = len(self._count)
        found: dict[str, Array] = {}
        for name in self._found[0][2]:
            found[name] = self._column(name, height, n)
        memory = found.pop("memory", None)
        starts = found.pop("starts")
        valid = np.arange(height)[:, None] < self._count
        return Experience(
            **found,  # type: ignore[arg-type]
            valid=None if valid.all() else valid,
            memory=None if memory is None else memory[0],
            starts=None if memory is None else starts,
        )

    def _column(self, name: str, height: int, n: int) -> Array:
        """One field of all decisions, (D, N, …); rewards of calls as long as the longest."""
        values = [value[name] for _, _, value in self._found]
        if name == "rewards":
            values = as_wide(values)
        whole = np.zeros((height, n, *values[0].shape[1:]), values[0].dtype)
        for (rows, ids, _), value in zip(self._found, values, strict=True):
            whole[rows, ids] = value
        return whole

    @staticmethod
    def _next_mask(collector: DecisionCollector, values: dict[str, Array], ids: Array) -> Array:
        """Where skills may start in the true successors: all where that does not matter."""
        mask = np.ones_like(values["obs_mask"])
        on = np.flatnonzero(~values["terminated"])
        if len(on):
            found = collector.skills.startable(values["next_obs"][on])
            if collector.guide is not None:
                found = collector.guide.ahead(collector.kept, ids[on], found)
            mask[on] = found | ~found.any(axis=1, keepdims=True)
        return mask

    @staticmethod
    def _nothing(collector: DecisionCollector) -> Experience:
        """One empty row: no call has ended."""
        obs, lead = collector.obs[None], (1, collector.num_envs)
        no = np.zeros(lead, bool)
        head, size = collector.open.get("head"), collector.acting.memory_size
        tells = collector.guide is not None and collector.guide.tells
        return Experience(
            obs=obs, action=np.zeros(lead, np.int64), reward=np.zeros(lead, np.float32),
            steps=np.ones(lead, np.int64), terminated=no, truncated=no, next_obs=obs, valid=no,
            head=None if head is None else np.zeros_like(head)[None],
            memory=np.zeros((collector.num_envs, size), np.float32) if size else None,
            starts=no if size else None,
            rewards=np.zeros((*lead, 1), np.float32) if collector.keep_rewards else None,
            guide=collector.kept["chances"][None] if tells else None,
        )  # fmt: skip
