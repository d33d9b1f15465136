"""The life of a call, in one place: who acts in N environments, and until when.

Training, evaluation, deployment, ``OptionsEnv`` and the search for start states all let skills act
through a ``Player``. Its memory is arrays with a row for each environment, changed in place. They
are named as follows; a hierarchy that is skill ``i`` has the same names under ``i.``:

- ``skill``: the running one, −1 where no call has started in the episode;
- ``elapsed``: steps of its call; ``limit``: the length that was chosen, where one is;
- ``end``: why the latest call ended (``CallEnd``), RUNNING where it has not;
- ``last_action``: the last action of the environment, as bytes, where it counts for a skill's own
  part (``Rest``);
- ``goal.i``: the goal of the latest call of skill ``i``, where it has goals;
- ``i.<key>``: what the policy of skill ``i`` remembers; ``base.i.<key>``: the policy that it
  corrects (``Residual``);
- ``selector.<key>``, ``guide.<key>``: the same of the selector and its guide; ``chances``: how
  likely the guide's latest choices were.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from skillweave.collecting.acting import Acting
from skillweave.collecting.call_end import (
    EPISODE,
    INTERRUPTED,
    LIMIT,
    OWN,
    RUNNING,
    Interruption,
    end_with_episode,
)
from skillweave.collecting.guide import ActiveGuide, LastCall
from skillweave.collecting.judge import judge, seen_by
from skillweave.collecting.skill_set import SkillSet
from skillweave.collecting.writer import TraceWriter
from skillweave.envs.infos import allowed_rows
from skillweave.errors import PolicyError, SkillError
from skillweave.skills import apply_reflexes, path_of
from skillweave.skills.goal_spaces import GOAL, OBSERVATION, SKILL
from skillweave.skills.goals import TRIES, CallGoals, Goals, goals_of
from skillweave.skills.outputs import blame
from skillweave.skills.own_part import ZERO, Rest
from skillweave.types import Array, Memory, Memoryless, Policy, Step


@dataclass(slots=True)
class Turn:
    """The way in which a player acts in one step."""

    deterministic: bool = True
    """The selector acts greedily, else it samples."""
    rng: np.random.Generator | None = None
    """The source of chance for policies that sample."""
    age: Array | None = None
    """(N,), steps of the episodes so far, for messages."""
    overridden: Array | None = None
    """(N,) bool, set where a reflex acts."""
    last_action: Array | None = None
    """(N, K), the last actions of the environments, as ``Rest.stored``; None: the player's own."""
    trace: TraceWriter | None = None
    """Where those who learn write what they choose; None: nothing is recorded."""


class Actor(Protocol):
    """Acts in some of N environments, with memory that is changed in place."""

    watches: bool
    """``observe`` has something to notice."""

    def start(self, n: int) -> Memory:
        """Return the memory of n environments in which it has not acted yet."""
        ...

    def act(self, memory: Memory, rows: Array, obs: Array, mask: Array | None, turn: Turn) -> Array:
        """Return actions (k, …) in environments ``rows`` (k,); ``obs`` and ``mask`` are of these.

        Args:
            memory: of all N environments.
        """
        ...

    def observe(self, memory: Memory, rows: Array, step: Step) -> Any:
        """Notice a step of environments ``rows`` (k,)."""
        ...


class PolicyActor:
    """A ``Policy`` among the actors.

    Args:
        blamed: what messages say of its errors: "skill 'x': its policy's act()".
    """

    def __init__(self, policy: Policy, blamed: str) -> None:
        self._policy, self._blamed = policy, blamed
        self.watches = getattr(type(policy), "observe", None) is not Memoryless.observe

    def start(self, n: int) -> Memory:
        """Return the policy's fresh memory."""
        return self._policy.start(n)

    def act(self, memory: Memory, rows: Array, obs: Array, mask: Array | None, turn: Turn) -> Array:
        """Return the policy's actions."""
        before = {k: v[rows] for k, v in memory.items()}
        how: Any = {"deterministic": turn.deterministic, "rng": turn.rng}
        try:
            actions, after = self._policy.act(before, obs, mask, **how)
        except (Exception, SystemExit) as error:
            blame(error, self._blamed)
        _put(memory, rows, after)
        return actions

    def observe(self, memory: Memory, rows: Array, step: Step) -> None:
        """Let the policy notice a step."""
        _put(memory, rows, self._policy.observe({k: v[rows] for k, v in memory.items()}, step))


class LearnerActor:
    """A network that learns, among the actors; what it chooses is written into the trace.

    Args:
        acting: the network.
        path: of the learner, before the names of its columns.
        decides: it is a selector: what it decided on is written, too.
    """

    watches = False

    def __init__(self, acting: Acting, path: str, *, decides: bool = False) -> None:
        self.acting = acting
        self.widen: Callable[[Array | None], Any] | None = None
        """Makes of a mask of skills one of what is chosen, where goals are part of it."""
        names = ("action", "dist_params", "decided", "obs", "allowed", "state_before")
        self._columns = [f"{path}/{name}" for name in (names if decides else names[:2])]

    @property
    def action_space(self) -> gym.Space[Any]:
        """The space of its actions in the environment's units."""
        space: gym.Space[Any] = self.acting.stacks[0][0].action_space
        return space

    def start(self, n: int) -> Memory:
        """Return zeros (n, M), where the network is recurrent."""
        size = self.acting.memory_size
        return {"rnn": np.zeros((n, size), np.float32)} if size else {}

    def act(self, memory: Memory, rows: Array, obs: Array, mask: Array | None, turn: Turn) -> Array:
        """Return actions (k, …) in the environment's units, as the latest request says."""
        before = memory["rnn"][rows] if "rnn" in memory else None
        allowed = mask if self.widen is None else self.widen(mask)
        acted = self.acting.some(rows, obs, allowed, before)
        if acted.recurrent_state is not None:
            memory["rnn"][rows] = acted.recurrent_state
        if turn.trace is not None:
            every = np.ones(len(rows), bool)
            values = acted.action, acted.dist_params, every, obs, mask, before
            turn.trace.write(rows, **dict(zip(self._columns, values, strict=False)))
        actions: Array = self.acting.to_env(acted.action)
        return actions

    def observe(self, memory: Memory, rows: Array, step: Step) -> None:
        """Notice nothing."""


class Player:
    """Skills in calls, and the selector that starts them.

    Args:
        skills: with their policies; one that is a ``Player`` or has one is a hierarchy.
        selector: chooses where a call has ended; None: the caller does, by ``begin``, or the guide.
        guide: a ready selector that restricts the choices, or makes them.
        own_goals: of the hierarchy, as a skill that has goals: what it is given to see is then
            observation and goal; selector and guide see both, the skills the observation.
    """

    watches = True

    def __init__(
        self,
        skills: SkillSet,
        selector: Any = None,
        guide: ActiveGuide | None = None,
        own_goals: Goals | None = None,
    ) -> None:
        self.skills, self.guide, self.own_goals = skills, guide, own_goals
        self.actors = tuple(
            actor_of(policy, f"skill {path_of(skill)!r}: its policy's act()")
            for skill, policy in zip(skills.skills, skills.policies, strict=True)
        )
        self.selector: Any = None
        if selector is not None:
            self.selector = actor_of(selector, "the selector's act()")
        self._ready = selector if hasattr(selector, "watch") else None
        self._keys = tuple(self._named(i, actor) for i, actor in enumerate(self.actors))
        self._selector_keys = () if self.selector is None else tuple(self.selector.start(1))
        self._limits = tuple(skills.limit(i) for i in range(len(self.actors)))
        self._stops = tuple(skill.defines("termination") for skill in skills.skills)
        self.restricts = skills.restricts
        every = ((i, goals_of(skill)) for i, skill in enumerate(skills.skills))
        self.goals: dict[int, Goals] = {i: goals for i, goals in every if goals is not None}
        """The goals of skills that have some, by their place in the list."""
        self._rest = Rest(ZERO, self.action_space) if skills.holds else None
        self._bases = {
            i: actor_of(part.base, f"{part.who}: the act() of the policy that it corrects")
            for i, part in enumerate(skills.parts)
            if part is not None and part.base is not None
        }
        self._base_keys = {i: self._named(i, base) for i, base in self._bases.items()}
        if isinstance(selector, LearnerActor) and self.goals:
            selector.widen = selector.acting.widened

    @property
    def action_space(self) -> gym.Space[Any]:
        """The environment's."""
        return self.skills.action_space

    @property
    def below(self) -> dict[int, Player]:
        """The skills that are hierarchies, by their place in the list."""
        return {i: a for i, a in enumerate(self.actors) if isinstance(a, Player)}

    def start(self, n: int) -> Memory:
        """Return the memory of n environments whose episodes start."""
        memory: Memory = {
            "skill": np.full(n, -1),
            "elapsed": np.zeros(n, np.int64),
            "end": np.full(n, EPISODE, np.int8),
        }
        if self.skills.lengths:
            memory["limit"] = np.zeros(n, np.int64)
        if self._rest is not None:
            memory["last_action"] = self._rest.start(n)
        memory |= {f"goal.{i}": goals.start(n) for i, goals in self.goals.items()}
        for i, actor in enumerate(self.actors):
            memory |= {f"{i}.{k}": v for k, v in actor.start(n).items()}
        for i, base in self._bases.items():
            memory |= {f"base.{i}.{k}": v for k, v in base.start(n).items()}
        if self.selector is not None:
            memory |= {f"selector.{k}": v for k, v in self.selector.start(n).items()}
        if self.guide is not None:
            memory |= self.guide.start(n)
            memory["chances"] = np.zeros((n, self.skills.choices), np.float32)
        return memory

    def restart(self, memory: Memory, rows: Array) -> None:
        """Start new episodes in environments ``rows`` (k,): no call has started."""
        memory["skill"][rows] = -1
        memory["end"][rows] = EPISODE
        if self._rest is not None:
            memory["last_action"][rows] = self._rest.start(len(rows))
        chooses = {} if self.selector is None else self.selector.start(len(rows))
        fresh = {f"selector.{k}": v for k, v in chooses.items()}
        if self.guide is not None:
            fresh |= self.guide.start(len(rows))
        _put(memory, rows, fresh)

    def act(self, memory: Memory, rows: Array, obs: Array, mask: Array | None, turn: Turn) -> Array:
        """Return actions (k, …) in environments ``rows`` (k,), after decisions where calls ended.

        Args:
            memory: of all environments.
            obs: (k, …).
            mask: (k, A) bool, actions that the environments allow; None: all. Networks keep to it;
                policies made elsewhere and reflexes may take another action.
        """
        ended = np.flatnonzero(memory["end"][rows] != RUNNING)
        if len(ended):
            every = len(ended) == len(rows)
            self._decide(memory, rows[ended], obs if every else obs[ended], turn)
        if self.own_goals is not None:
            obs = obs[OBSERVATION]
        return self.act_in_calls(memory, rows, obs, mask, turn)

    def act_in_calls(
        self, memory: Memory, rows: Array, obs: Array, mask: Array | None, turn: Turn
    ) -> Array:
        """Return actions (k, …) as of ``act``, where calls run in all environments ``rows``."""
        running, actions = memory["skill"][rows], None
        last = memory.get("last_action") if turn.last_action is None else turn.last_action
        own = Turn(self.skills.greedy, turn.rng, turn.age, turn.overridden, last, turn.trace)
        for i in range(len(self.actors)):
            mine = np.flatnonzero(running == i)
            if not len(mine):
                continue
            if len(mine) == len(rows):
                actions = self._act_skill(memory, i, rows, obs, mask, own)
                break
            allowed = allowed_rows(mask, mine)
            some = self._act_skill(memory, i, rows[mine], obs[mine], allowed, own)
            if actions is None:
                actions = np.zeros((len(rows), *some.shape[1:]), some.dtype)
            actions[mine] = some
        assert actions is not None, "no call runs"
        if self.skills.reflexes:
            reflexes = self.skills.reflexes
            actions, holds = apply_reflexes(reflexes, obs, actions, self.action_space)
            if turn.overridden is not None:
                turn.overridden[rows] |= holds
        return actions

    def _act_skill(
        self, memory: Memory, i: int, rows: Array, obs: Array, mask: Array | None, turn: Turn
    ) -> Array:
        """Return the actions (k, …) of skill ``i`` in ``rows`` (k,), of which it may own a part."""
        part, seen, allowed = self.skills.part(i), self._seen(memory, i, rows, obs), mask
        if part is not None:
            allowed = part.mask(mask)
        actions: Array = self.actors[i].act(self.of_skill(memory, i), rows, seen, allowed, turn)
        if part is None:
            return actions
        last = None if turn.last_action is None else turn.last_action[rows]
        corrected = None
        if i in self._bases:
            how = Turn(True, turn.rng)
            corrected = self._bases[i].act(self.of_base(memory, i), rows, seen, None, how)
        actions = part.write(actions, last, corrected)
        part.check_mask(mask, actions)
        return actions

    def begin(
        self,
        memory: Memory,
        rows: Array,
        choice: Array,
        goals: Mapping[int, Array] | None = None,
    ) -> None:
        """Start the calls of ``choice`` (k,) in environments ``rows`` (k,).

        A skill that is called again at once, in the same episode, goes on with its memory; after
        another skill's call, or in a new episode, it starts with a fresh one. So does a hierarchy
        that has goals, in each call.

        Args:
            goals: by the places of skills that have goals, (k, *goal_shape), checked; they count
                where the skill is chosen. None: no chosen skill has goals.

        Raises:
            SkillError: a chosen skill has goals, and there is none for it.
        """
        skill, lengths = self.skills.skill_of(choice), self.skills.lengths
        for i, own in self.goals.items():
            mine = np.flatnonzero(skill == i)
            if not len(mine):
                continue
            if goals is None or i not in goals:
                raise SkillError(
                    f"skill {path_of(self.skills.skills[i])!r} has goals (goal_space), but was "
                    f"called without one: choose it with a goal, ({self.skills.skills[i].name!r}, "
                    "goal)"
                )
            memory[f"goal.{i}"][rows[mine]] = own.stored(goals[i][mine])
        if lengths:
            memory["limit"][rows] = np.array(lengths)[choice % len(lengths)]
        changed = memory["skill"][rows] != skill
        memory["skill"][rows] = skill
        memory["elapsed"][rows] = 0
        memory["end"][rows] = RUNNING
        for i, keys in enumerate(self._keys):
            afresh = changed | (i in self.goals and isinstance(self.actors[i], Player))
            if keys and len(fresh := rows[afresh & (skill == i)]):
                _put(self.of_skill(memory, i), fresh, self.actors[i].start(len(fresh)))
        for i, base in self._bases.items():
            if self._base_keys[i] and len(fresh := rows[changed & (skill == i)]):
                _put(self.of_base(memory, i), fresh, base.start(len(fresh)))

    def observe(self, memory: Memory, rows: Array, step: Step) -> Array:
        """Notice a step of environments ``rows`` (k,); return why calls ended, (k,) int8.

        Args:
            step: of these environments; ``elapsed`` counts as the caller of this player does; each
                skill sees the time of its own call.
        """
        memory["elapsed"][rows] += 1
        if self._rest is not None:
            memory["last_action"][rows] = self._rest.stored(step.action)
        elapsed, running = memory["elapsed"][rows], memory["skill"][rows]
        end = np.zeros(len(rows), np.int8)
        if self.skills.lengths:
            end[elapsed >= memory["limit"][rows]] = LIMIT
        for i, limit in enumerate(self._limits):
            if limit is not None:
                end[(running == i) & (elapsed >= limit)] = LIMIT
        for i, actor in enumerate(self.actors):
            if actor.watches or self._stops[i] or self._base_watches(i):
                mine = np.flatnonzero(running == i)
                if len(mine):
                    self._observe_skill(memory, i, rows, mine, elapsed[mine], step, end)
        if self.skills.interruption is not None:
            self._interrupt(self.skills.interruption, memory, rows, step, end)
        end_with_episode(end, step.terminated | step.truncated)
        memory["end"][rows] = end
        self._watch(memory, rows, step, running, elapsed, end)
        return end

    def allowed(self, memory: Memory, rows: Array, obs: Array) -> Array | None:
        """Return the choices that may be made next in environments ``rows`` (k,), (k, choices).

        Nothing changes: of a guide, only what is known before it sees ``obs`` (k, …) counts. None:
        all, always. Where none is left, all are True.
        """
        if not self.restricts and self.guide is None:
            return None
        may = self.skills.startable(obs)
        if self.guide is not None:
            may = self.guide.ahead(memory, rows, may)
        return may | ~may.any(axis=1, keepdims=True)

    def of_skill(self, memory: Memory, i: int) -> Memory:
        """Return the memory of skill ``i``'s policy, the same arrays under its own names."""
        return {k: memory[f"{i}.{k}"] for k in self._keys[i]}

    def of_base(self, memory: Memory, i: int) -> Memory:
        """Return the memory of the policy that skill ``i`` corrects, under its own names."""
        return {k: memory[f"base.{i}.{k}"] for k in self._base_keys[i]}

    def _base_watches(self, i: int) -> bool:
        """Return whether the policy that skill ``i`` corrects notices steps."""
        return i in self._bases and bool(self._bases[i].watches)

    def of_selector(self, memory: Memory) -> Memory:
        """Return the selector's memory, the same arrays under its own names."""
        return {k: memory[f"selector.{k}"] for k in self._selector_keys}

    def _decide(
        self, memory: Memory, rows: Array, seen: Array, turn: Turn, tries: int = TRIES
    ) -> None:
        """Choose in environments ``rows`` (k,), and start the calls.

        A call whose goal holds already ends at no step, and is no decision: a selector that samples
        chooses again. After the last of its ``tries`` the call runs; so does that of a selector
        that would choose the same again.

        Args:
            seen: (k, …) what the selector sees.
        """
        obs = seen if self.own_goals is None else seen[OBSERVATION]
        may, guide = self.skills.mask(obs, None if turn.age is None else turn.age[rows]), self.guide
        greedy = turn.deterministic and self.skills.greedy_selector
        if guide is not None and guide.decides and self.goals:
            may = self.skills.startable(obs) if may is None else may
            choice = guide.choose(memory, rows, seen, may, turn.deterministic, turn.rng)
            self._begin_with_goals(memory, rows, choice, obs)
            return
        if guide is not None:
            may = self.skills.startable(obs) if may is None else may
            chances = guide.ask(memory, rows, seen, may, turn.deterministic, turn.rng)
            memory["chances"][rows] = chances
            may = chances > 0.0 if guide.restricts else may
        if self.selector is None:
            assert may is not None, "nothing chooses"
            self.begin(memory, rows, may.argmax(axis=1))  # the guide has left one
            return
        how, own = Turn(greedy, turn.rng, turn.age, trace=turn.trace), self.of_selector(memory)
        before = {k: v[rows] for k, v in own.items()}
        choice = np.asarray(self.selector.act(own, rows, seen, may, how))
        self._begin_with_goals(memory, rows, choice, obs)
        samples = isinstance(self.selector, LearnerActor) or not greedy
        if samples and self._ready is None and tries > 1:
            again = np.flatnonzero(self._holds(memory, rows, obs))
            if len(again):
                _put(own, rows[again], {k: v[again] for k, v in before.items()})
                self._decide(memory, rows[again], seen[again], turn, tries - 1)

    def _holds(self, memory: Memory, rows: Array, obs: Array) -> Array:
        """Return where the goals of calls that start in ``obs`` (k, …) hold already, (k,) bool."""
        holds = np.zeros(len(rows), bool)
        for i, goals in self.goals.items():
            if len(mine := np.flatnonzero(memory["skill"][rows] == i)):
                goal = goals.read(memory[f"goal.{i}"][rows[mine]])
                holds[mine] = goals.hold(obs[mine], goal)
        return holds

    def _begin_with_goals(self, memory: Memory, rows: Array, choice: Array, obs: Array) -> None:
        """Start the calls of choices (k,), which have goals if the selector gives some."""
        if choice.dtype.fields is None:
            self.begin(memory, rows, choice)
        else:
            goals = self.goals_in(choice, obs, "the selector")
            self.begin(memory, rows, choice[SKILL], goals)

    def goals_in(self, choice: Array, obs: Array, who: str) -> dict[int, Array]:
        """Return the goals of choices (k,) of a ``choice_space``, checked, for ``begin``.

        Args:
            obs: (k, …), where the calls start.
            who: whose choices they are, for messages.

        Raises:
            SkillError: a goal is out of its space.
        """
        skill, found = self.skills.skill_of(choice[SKILL]), dict[int, Array]()
        for i, goals in self.goals.items():
            mine = np.flatnonzero(skill == i)
            if not len(mine):
                continue
            given = np.array(choice[GOAL][self.skills.skills[i].name])
            given[mine] = goals.fitted(obs[mine], given[mine], who)
            found[i] = given
        return found

    def _observe_skill(
        self, memory: Memory, i: int, rows: Array, mine: Array, elapsed: Array, step: Step,
        end: Array,
    ) -> None:  # fmt: skip
        """Let skill ``i`` notice a step in ``rows[mine]``; where its call ends, set ``end``."""
        skill, actor = self.skills.skills[i], self.actors[i]
        part = seen_by(skill, step, elapsed, mine, self.goal_of(memory, i, rows[mine]))
        if actor.watches:
            below, own = self.of_skill(memory, i), self.skills.part(i)
            actor.observe(below, rows[mine], part if own is None else own.own_step(part))
            if isinstance(actor, Player) and actor.restricts:
                end[mine[actor.is_stuck(below, rows[mine], part.next_obs)]] = LIMIT
        if self._base_watches(i):
            own = self.skills.part(i)
            assert own is not None
            seen = own.own_step(part)
            self._bases[i].observe(self.of_base(memory, i), rows[mine], seen)
        if self._stops[i]:
            end[mine[judge(skill, part, rows[mine]).stops]] = OWN

    def is_stuck(self, memory: Memory, rows: Array, obs: Array) -> Array:
        """(k,) bool, the selector must decide, but no skill may start; its own call ends there."""
        stuck = np.zeros(len(rows), bool)
        end = memory["end"][rows]
        waits = np.flatnonzero((end != RUNNING) & (end != EPISODE))
        if len(waits):
            stuck[waits] = ~self.skills.startable(obs[waits]).any(axis=1)
        return stuck

    def _interrupt(
        self, how: Interruption, memory: Memory, rows: Array, step: Step, end: Array
    ) -> None:
        """End calls where a new decision is worth clearly more, in place.

        What a call is worth is that of its skill with its goal.
        """
        mine = np.flatnonzero(end == RUNNING)
        if not len(mine):
            return
        rows, obs, n = rows[mine], step.next_obs[mine], len(self.actors)
        running, seen = memory["skill"][rows], obs
        if self.own_goals is not None:
            seen = self.own_goals.join(obs, step.goal[mine])
        if self.goals:
            goals = {i: of.read(memory[f"goal.{i}"][rows]) for i, of in self.goals.items()}
            seen = CallGoals(self.goals).join(seen, running, goals)
        worth = how.worth(seen)
        goes_on = worth[np.arange(len(rows)), running]
        may = self.skills.startable(obs)[:, :: max(1, len(self.skills.lengths))]
        again = np.where(may.any(axis=1), worth[:, n], -np.inf)  # else no skill could be called
        end[mine[again - goes_on > how.margin]] = INTERRUPTED

    def _watch(
        self, memory: Memory, rows: Array, step: Step, running: Array, elapsed: Array, end: Array
    ) -> None:
        """Show a step to a guide and to a ready selector, and how the last calls ended."""
        if self.guide is None and self._ready is None:
            return
        succeeded = self.succeeded(rows, step, running, elapsed, end, memory)
        last = LastCall(running, end, succeeded)
        if self.guide is not None:
            self.guide.watch(memory, rows, step, last)
        if self._ready is not None:
            below = self.of_selector(memory)
            before = {k: v[rows] for k, v in below.items()}
            _put(below, rows, self._ready.watch(before, step, last))

    def succeeded(
        self,
        rows: Array,
        step: Step,
        running: Array,
        elapsed: Array,
        end: Array,
        memory: Memory | None = None,
    ) -> Array:
        """(k,) bool: the calls that are over have succeeded.

        By the skill's ``success``; of a skill without one, if its own termination ended the call.

        Args:
            memory: of all environments; None: no skill has goals.
        """
        found: Array = end == OWN
        for i, skill in enumerate(self.skills.skills):
            if not skill.defines("success"):
                continue
            over = np.flatnonzero((running == i) & (end != RUNNING))
            if len(over):
                goal = None if memory is None else self.goal_of(memory, i, rows[over])
                part = seen_by(skill, step, elapsed[over], over, goal)
                found[over] = judge(skill, part, rows[over]).success
        return found

    def drawn_goals(self, choice: Array, obs: Array, rng: np.random.Generator) -> dict[int, Array]:
        """Return goals to practise in calls of ``choice`` (k,) in ``obs`` (k, …), for ``begin``."""
        skill, found = self.skills.skill_of(choice), dict[int, Array]()
        for i, goals in self.goals.items():
            mine = np.flatnonzero(skill == i)
            if len(mine):
                found[i] = goals.read(goals.start(len(choice))).copy()
                found[i][mine] = goals.draw(obs[mine], rng)
        return found

    def goal_of(self, memory: Memory, i: int, rows: Array) -> Array | None:
        """Return the goals of skill ``i`` in ``rows`` (k,); None: it has none."""
        goals = self.goals.get(i)
        return None if goals is None else goals.read(memory[f"goal.{i}"][rows])

    def _seen(self, memory: Memory, i: int, rows: Array, obs: Array) -> Array:
        """Return what skill ``i`` sees in ``rows`` (k,): ``obs`` (k, …) or its part, and a goal."""
        goals, part = self.goals.get(i), self.skills.part(i)
        obs = obs if part is None else part.see(obs)
        if goals is None:
            return obs
        return goals.join(obs, goals.read(memory[f"goal.{i}"][rows]))

    def _named(self, i: int, actor: Actor) -> tuple[str, ...]:
        """The names of what a policy of skill ``i`` remembers, checked."""
        fresh = actor.start(1)
        for k, v in fresh.items():
            if v.dtype.kind not in "biuf":  # a checkpoint could not hold it
                raise PolicyError(
                    f"skill {self.skills.skills[i].name!r}: its policy remembers {k!r} as "
                    f"{v.dtype}; a memory is an array of numbers whose first axis is the "
                    "environment"
                )
        return tuple(fresh)


def player_of(policy: Any) -> Player | None:
    """Return the player of a policy that is a hierarchy; None: it is none."""
    found = policy if isinstance(policy, Player) else getattr(policy, "player", None)
    return found if isinstance(found, Player) else None


def actor_of(policy: Any, blamed: str) -> Any:
    """Return an ``Actor`` that acts by a policy; ``blamed`` as of ``PolicyActor``."""
    if isinstance(policy, LearnerActor):
        return policy
    return player_of(policy) or PolicyActor(policy, blamed)


def _put(memory: Memory, rows: Array, values: Memory) -> None:
    for k, v in values.items():
        memory[k][rows] = v
