"""The life of a call, in one place: which skill acts in each environment, and until when.

A ``CallAndReturn`` remembers, for each environment:

- ``skill``: the running one, −1 where no call has started in the episode;
- ``elapsed``: steps of its call; ``length``: the one that was chosen, where one is;
- ``end``: why the latest call ended (``CallEnd``), RUNNING where it has not;
- ``goal``: by the place of a skill with goals, that of its latest call;
- by the place of each skill what its policy remembers; ``selector`` and ``guide``: the same;
- ``chances``: how likely the guide's latest choices were;
- ``before``: where skills fade in, the skill before while it acts on, else −1; ``before_elapsed``:
  the steps of its call, which count on; ``faded``: the steps since the other one acts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from .acting_errors import PolicyError, SkillError
from .core import (
    EPISODE,
    INTERRUPTED,
    LIMIT,
    OWN,
    RUNNING,
    Array,
    CallUser,
    Choices,
    LastCall,
    Memory,
    RowPolicy,
    Step,
    Turn,
    World,
    call_plainly,
    code,
    end_with_episode,
    observed,
    own_step,
    part_of,
    put,
    take,
)
from .leaves import Selector
from .mapped import LONGEST, mixed
from .parts import GOAL, OBSERVATION, joined, joint_dtype, with_goal
from .spaces import Space, discrete

SKILL = "skill"
"""The part of a choice that names the skill; ``GOAL`` has a goal for each skill with goals."""
TRIES = 16
"""The most goals that are chosen for a call, where those before hold already."""


@dataclass(eq=False)
class CallGoals:
    """The goals that calls of an acting skill have, one for each call."""

    name: str
    """The skill's name, for messages."""
    space: Space
    clip: Callable[..., Any] | None = code(
        "observations and goals (n, ...) to goals (n, ...)", "clip_goal", needed=False
    )

    def start(self, n: int) -> Array:
        """Return goals of n environments without a call, (n, *goal_shape)."""
        return self.space.start(n)

    def fitted(self, obs: Array, goal: Any, who: str) -> Array:
        """Return goals (n, …) for calls that start in ``obs`` (n, …), clipped and checked.

        Args:
            goal: of each of the n environments.
            who: whose goals they are, for messages.

        Raises:
            SkillError: they have another shape or type, or are out of the space.
        """
        n = len(obs)
        skill = f"skill {self.name!r}"
        goals = self.space.goals(goal, n, who, skill)
        if self.clip is not None:
            who = f"{skill}: clip_goal()"
            goals = self.space.goals(self.clip(obs, goals), n, who, skill)
        return self.inside(goals, who)

    def inside(self, goals: Array, who: str) -> Array:
        """Return the goals (n, …) of an acting skill's calls, which are in its space.

        Raises:
            SkillError: one is not; ``who`` gave it.
        """
        if not (inside := self.space.holds(goals)).all():
            says = self.space.is_out(goals[~inside][0], who, f"skill {self.name!r}")
            advice = "; give one in it, or let the skill move goals into it: clip_goal(obs, goal)"
            raise SkillError(says + advice * (self.clip is None))
        return goals

    def hold(self, obs: Array, goal: Array, termination: Callable[..., Any] | None) -> Array:
        """Return the goals (n, …) for which a call would end at once, (n,) bool.

        For them the skill's ``termination`` is true for a step that stands still in ``obs`` (n, …).
        Where it fails for such a step, as it reads ``info`` for example, no goal holds.
        """
        zeros, ones = np.zeros(len(obs), np.float32), np.ones(len(obs), np.int64)
        no = zeros > 0
        still = Step(obs, zeros, obs, zeros, no, no, no, ones, {}, goal)
        ends: Any = termination
        with suppress(Exception), np.errstate(all="ignore"):
            return np.array(ends(still), bool).reshape(len(obs))
        return no


@dataclass(eq=False)
class CalledSkill:
    """A skill as ``CallAndReturn`` acts with it: its policy, and when calls of it start and end."""

    name: str
    path: str
    """Its name in messages."""
    policy: RowPolicy
    limit: int | None = None
    """Steps after which a call is cut; None: never."""
    max_steps: int | None = None
    """The skill's own limit of these two: its functions see that it is ``timed_out``."""
    initiation: Callable[..., Any] | None = code(
        "observations (n, ...) to (n,) bool", "initiation", needed=False
    )
    termination: Callable[..., Any] | None = code(
        "a Step to (n,) bool", "termination", needed=False
    )
    success: Callable[..., Any] | None = code("a Step to (n,) bool", "success", needed=False)
    goals: Any = field(default=None, metadata={"kind": CallGoals | None})
    """``CallGoals``, or what else has their methods; None: it has none."""
    fades: tuple[int, ...] = ()
    """By the place of the skill before, the steps in which that one acts on, and actions mix; 0:
    none. (): after none."""

    def __post_init__(self) -> None:
        if any(not 0 <= steps <= LONGEST for steps in self.fades):
            raise PolicyError(f"fades are {self.fades}; they must be 0 to {LONGEST:,} steps")
        for name in ("limit", "max_steps"):
            steps = getattr(self, name)
            if steps is not None and steps < 1:
                raise PolicyError(f"{name} is {steps}; it must be at least 1")


@dataclass(eq=False)
class Critic:
    """A policy whose actions are the values of skills, for an ``Interruption``."""

    policy: RowPolicy

    def __call__(self, obs: Array) -> Array:
        """Return the values (n, S + 1) of observations (n, …)."""
        n = len(obs)
        return self.policy.act(self.policy.start(n), np.arange(n), obs, Turn(World()))


@dataclass(eq=False)
class Interruption:
    """A rule by which the selector ends a call (Sutton, Precup & Singh 1999, sec. 4)."""

    worth: Critic | Callable[[Array], Array]
    """From observations (n, …), the value of each skill and last of a new decision, (n, S + 1), in
    deviations of the return."""
    margin: float
    """The gain in value at which a new decision ends a call, in the same unit."""
    critic: Any = field(default=None, metadata={"written": False})
    """The trained critic, if there is one."""


@dataclass(eq=False)
class ActiveGuide:
    """A ready selector that is asked wherever a selector decides."""

    selector: Any = field(metadata={"kind": Selector})
    restricts: bool = True
    """Only what it may choose is allowed."""
    tells: bool = False
    """Record its action probabilities for the KL penalty."""
    decides: bool = False
    """It is the selector itself."""


NEVER = np.iinfo(np.int64).max


@dataclass(eq=False)
class CallAndReturn(Choices, RowPolicy):
    """Skills in calls, and the selector that starts them where a call has ended.

    A choice is a number: of a skill, or of a skill and one of the ``lengths``; where skills have
    goals, a record of such a number and a goal for each of them, by name.

    Args:
        selector: chooses; None: the caller does, by ``begin``.
        skills: in order.
        lengths: the lengths that are chosen together with skills; (): none is chosen.
        guide: with a ``Selector``: restricts the choices, or only tells what it would choose.
        interruption: when the selector cuts a call; None: never.
        fresh_calls: it is a skill that has goals: selector and guide see them beside observations,
            the skills do not, and each of its calls begins with a fresh memory.
        greedy: its skills are; else they sample.
        greedy_selector: its selector is, where its caller acts greedily; else it samples.
        call_user: calls a function of a user, and checks its answer.

    Raises:
        PolicyError: lengths do not rise, or a skill's ``fades`` are of other skills.
    """

    watches = True

    selector: RowPolicy | None
    skills: tuple[CalledSkill, ...]
    lengths: tuple[int, ...] = ()
    guide: ActiveGuide | None = None
    interruption: Interruption | None = None
    fresh_calls: bool = False
    greedy: bool = True
    greedy_selector: bool = True
    call_user: CallUser = field(default=call_plainly, metadata={"written": False})

    def __post_init__(self) -> None:
        if any(a >= b for a, b in pairwise((0, *self.lengths))):
            raise PolicyError(f"a hierarchy has the lengths {self.lengths[:5]}, which must rise")
        self.restricts = any(s.initiation or s.policy.restricts for s in self.skills)
        self.holds = any(skill.policy.holds for skill in self.skills)
        self._limits = np.array([NEVER if s.limit is None else s.limit for s in self.skills])
        self._asked = {
            i for i, s in enumerate(self.skills) if s.policy.watches or s.termination is not None
        }
        self.goals = {i: s.goals for i, s in enumerate(self.skills) if s.goals is not None}
        """The goals of skills that have some, by their place in the list."""
        self._fresh = np.array(
            [s.goals is not None and s.policy.fresh_calls for s in self.skills], bool
        )
        count = len(self.skills)
        if wrong := [s.name for s in self.skills if s.fades and len(s.fades) != count]:
            raise PolicyError(f"skill {wrong[0]!r}: fades must have {count} numbers")
        none = (0,) * count
        self._fades: Array | None = None
        """(S, S), the steps in which a skill, the row, fades in after another one."""
        if any(any(s.fades) for s in self.skills):
            self._fades = np.array([s.fades or none for s in self.skills])
        self._again = [i for i, s in enumerate(self.skills) if s.policy.forgets]
        guide = None if self.guide is None else self.guide.selector
        ready = {"selector": self.selector, "guide": guide}
        self._ready = {name: who for name, who in ready.items() if isinstance(who, Selector)}

    def start(self, n: int) -> Memory:
        """Return the memory of n environments whose episodes start: no call has started."""
        memory: Memory = {
            "skill": np.full(n, -1),
            "elapsed": np.zeros(n, np.int64),
            "end": np.full(n, EPISODE, np.int8),
        }
        if self.lengths:
            memory["length"] = np.zeros(n, np.int64)
        if self._fades is not None:
            memory["before"] = np.full(n, -1)
            memory["before_elapsed"] = np.zeros(n, np.int64)
            memory["faded"] = np.zeros(n, np.int64)
        if self.goals:
            memory["goal"] = {str(i): goals.start(n) for i, goals in self.goals.items()}
        memory |= {str(i): skill.policy.start(n) for i, skill in enumerate(self.skills)}
        if self.selector is not None:
            memory["selector"] = self.selector.start(n)
        if self.guide is not None:
            memory["guide"] = self.guide.selector.start(n)
            memory["chances"] = np.zeros((n, self.choices), np.float32)
        return memory

    # Acting -------------------------------------------------------------------------------------

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return actions (k, …) in environments ``rows`` (k,), after decisions where calls ended.

        Args:
            memory: of all environments.
            obs: (k, …).
            turn: its mask are actions that the environments allow. Networks keep to it; policies
                made elsewhere may take another action.
        """
        ended = np.flatnonzero(memory["end"][rows] != RUNNING)
        if len(ended) == len(rows):
            self.begin(memory, rows, self._choice(memory, rows, obs, turn))
        elif len(ended):
            at = rows[ended]
            part = turn.some(ended)
            self.begin(memory, at, self._choice(memory, at, obs[ended], part))
        running = memory["skill"][rows]
        actions = None
        own = Turn(turn.world, turn.mask, None, self.greedy)
        fades = self._fades is not None
        for i, mine in _by_skill(running):
            every = len(mine) == len(rows)
            part = own if every else own.some(mine)
            at = rows if every else rows[mine]
            part.goal = self.goal_of(memory, i, at)
            seen = obs if every else obs[mine]
            some = self.skills[i].policy.act(memory[str(i)], at, seen, part)
            if every:
                return self._faded(memory, rows, obs, own, some) if fades else some
            if actions is None:
                actions = np.zeros((len(rows), *some.shape[1:]), some.dtype)
            actions[mine] = some
        assert actions is not None, "no call runs"
        return self._faded(memory, rows, obs, own, actions) if fades else actions

    def _faded(self, memory: Memory, rows: Array, obs: Array, turn: Turn, actions: Array) -> Array:
        """Return actions (k, …) in which those of the skill before fade out."""
        before = memory["before"][rows]
        mixing = np.flatnonzero(before >= 0)
        if not len(mixing):
            return actions
        assert self._fades is not None
        steps = self._fades[memory["skill"][rows[mixing]], before[mixing]]
        memory["faded"][rows[mixing]] += 1
        share = memory["faded"][rows[mixing]] / steps
        goes_on = share < 1.0
        memory["before"][rows[mixing[~goes_on]]] = -1
        mixing, share = mixing[goes_on], share[goes_on]
        # What learns records nothing here: it is another skill's call.
        world = turn.world
        beside = World(world.rng, world.age, world.last_action, world.acted)
        for i, mine in _by_skill(before[mixing]):
            skill, at = self.skills[i], rows[mixing[mine]]
            if skill.policy.restricts:
                stuck = skill.policy.stuck(memory[str(i)], at, obs[mixing[mine]])
                mine = mine[~np.broadcast_to(stuck, mine.shape)]
                at = rows[mixing[mine]]
            if not len(mine):
                continue
            part = turn.some(mixing[mine])
            part.world = beside
            part.goal = self.goal_of(memory, i, at)
            theirs = skill.policy.act(memory[str(i)], at, obs[mixing[mine]], part)
            actions = mixed(actions, theirs, share[mine], mixing[mine])
        return actions

    def _choice(
        self, memory: Memory, rows: Array, obs: Array, turn: Turn, tries: int = TRIES
    ) -> Array:
        """Return choices (k,), with checked goals where skills have some.

        A call whose goal holds already ends at no step, and is no decision: a selector that samples
        chooses again. Its last of ``tries`` counts; so does that of a selector that would choose
        the same again.
        """
        world = turn.world
        selector = self.selector
        seen = obs
        may = self.mask(obs, None if world.age is None else world.age[rows])
        assert selector is not None, "nothing chooses"
        if self.fresh_calls:
            assert turn.goal is not None
            seen = joined(obs, turn.goal)
        if self.guide is not None:
            may = self.may_start(obs) if may is None else may
            chances = self.guide.selector.chances(memory["guide"], rows, seen, may)
            memory["chances"][rows] = chances
            may = chances > 0.0 if self.guide.restricts else may
        how = Turn(world, may, None, turn.greedy and self.greedy_selector)
        before = take(memory["selector"], rows) if self.goals else {}
        choice = np.asarray(selector.act(memory["selector"], rows, seen, how))
        if choice.dtype.fields is None:
            return choice
        choice = self.fitted(choice, obs, "the selector")
        if tries > 1 and selector.redraws(how.greedy):
            again = np.flatnonzero(self._holds(choice, obs))
            if len(again):
                put(memory["selector"], rows[again], take(before, again))
                some = turn.some(again)
                choice[again] = self._choice(memory, rows[again], obs[again], some, tries - 1)
        return choice

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
            choice: perhaps with checked goals.
            goals: else by the places of skills that have goals, (k, *goal_shape), checked; they
                count where the skill is chosen.

        Raises:
            SkillError: a chosen skill has goals, and there is none for it.
        """
        if choice.dtype.fields is not None:
            goals = {i: choice[GOAL][self.skills[i].name] for i in self.goals}
            choice = choice[SKILL]
        choice = np.asarray(choice).astype(np.int64, copy=False)
        skill = self.skill_of(choice)
        if not ((skill >= 0) & (skill < len(self.skills))).all():
            raise SkillError(
                f"the selector chose {choice.tolist()}, but there are {self.choices} choices, "
                f"from 0 to {self.choices - 1}"
            )
        for i in self.goals:
            mine = np.flatnonzero(skill == i)
            if not len(mine):
                continue
            if goals is None or i not in goals:
                raise SkillError(
                    f"skill {self.skills[i].path!r} has goals (goal_space), but was called without "
                    f"one: choose it with a goal, ({self.skills[i].name!r}, goal)"
                )
            memory["goal"][str(i)][rows[mine]] = goals[i][mine]
        if self.lengths:
            memory["length"][rows] = np.array(self.lengths)[choice % self.each]
        before = memory["skill"][rows]
        fresh = (before != skill) | self._fresh[skill]
        if self._fades is not None:
            other = before != skill
            at = rows[other]
            fades = (before >= 0) & (self._fades[skill, before] > 1)
            memory["before"][at] = np.where(fades, before, -1)[other]
            memory["before_elapsed"][at] = memory["elapsed"][at]
            memory["faded"][at] = 0
        for i in self._again:
            if len(mine := rows[~fresh & (skill == i)]):
                self.skills[i].policy.again(memory[str(i)], mine)
        memory["skill"][rows] = skill
        memory["elapsed"][rows] = 0
        memory["end"][rows] = RUNNING
        for i, own in enumerate(self.skills):
            if memory[str(i)] and len(mine := rows[fresh & (skill == i)]):
                put(memory[str(i)], mine, own.policy.start(len(mine)))

    def _holds(self, choice: Array, obs: Array) -> Array:
        """Return where the goals of choices (k,) hold in ``obs`` (k, …) already, (k,) bool."""
        holds = np.zeros(len(choice), bool)
        for i, mine in self._with_goals(choice):
            goal = choice[GOAL][self.skills[i].name][mine]
            holds[mine] = self.goals[i].hold(obs[mine], goal, self.skills[i].termination)
        return holds

    def fitted(self, choice: Array, obs: Array, who: str) -> Array:
        """Return choices (k,) with checked goals.

        Args:
            obs: (k, …), where the calls start.
            who: whose choices they are, for messages.

        Raises:
            SkillError: a goal is out of its space.
        """
        choice = choice.copy()
        for i, mine in self._with_goals(choice):
            given = choice[GOAL][self.skills[i].name]
            given[mine] = self.goals[i].fitted(obs[mine], given[mine], who)
        return choice

    def _with_goals(self, choice: Array) -> Iterator[tuple[int, Array]]:
        """Yield the skills with goals that are chosen, and where in choices (k,)."""
        skill = self.skill_of(choice[SKILL])
        for i in self.goals:
            if len(mine := np.flatnonzero(skill == i)):
                yield i, mine

    def goal_of(self, memory: Memory, i: int, rows: Array) -> Array | None:
        """Return the goals of skill ``i`` in ``rows`` (k,); None: it has none."""
        return memory["goal"][str(i)][rows] if i in self.goals else None

    def beside_calls(self, obs: Array, running: Array, goals: Mapping[int, Array]) -> Array:
        """Return observations with the goals of calls, as a critic of skills sees them.

        Only the goal of the running skill counts; the others are as where an episode starts.

        Args:
            obs: (…, *obs_shape).
            running: (…) int64, the running skills.
            goals: by place, (…, *goal_shape) of the latest calls; one that is missing has no call.

        Returns:
            One array (…) of observations and goals by the names of skills.
        """
        lead = running.shape
        blank = {self.skills[i].name: own.start(1)[0] for i, own in self.goals.items()}
        kinds = [(name, one.dtype, one.shape) for name, one in blank.items()]
        goal = np.dtype(kinds, align=True)
        joint = np.zeros(lead, joint_dtype(obs.dtype, obs.shape[len(lead) :], goal, ()))
        joint[OBSERVATION] = obs
        for name, one in blank.items():
            joint[GOAL][name] = one
        for i, values in goals.items():
            runs = running == i
            joint[GOAL][self.skills[i].name][runs] = values[runs]
        return joint

    # Where skills may start ---------------------------------------------------------------------

    def mask(self, obs: Array, age: Array | None = None) -> Array | None:
        """Return the allowed choices, (k, choices) bool; None: all, everywhere.

        Args:
            age: (k,), steps of the episodes so far, for messages.

        Raises:
            SkillError: in some observation no skill may start.
        """
        if not self.restricts:
            return None
        may = self.may_start(obs)
        if not may.any(axis=1).all():
            row = int(np.flatnonzero(~may.any(axis=1))[0])
            names = ", ".join(repr(skill.path) for skill in self.skills)
            where = observed(obs[row])
            where += "" if age is None else f", after {int(age[row])} steps of the episode"
            raise SkillError(
                f"no skill may start in observation {where}: the initiation() of {names} is False "
                "there. Let at least one start everywhere"
            )
        return may

    def may_start(self, obs: Array) -> Array:
        """Return the choices whose skill may start, (k, choices); perhaps none somewhere."""
        may = np.empty((len(obs), len(self.skills)), bool)
        rows = np.arange(len(obs))
        for i, skill in enumerate(self.skills):
            may[:, i] = skill.policy.startable(obs) if skill.policy.restricts else True
            if skill.initiation is not None:
                may[:, i] &= self.call_user(skill.initiation, obs, rows, skill.path, "initiation")
        return may.repeat(self.each, axis=1)

    def startable(self, obs: Array) -> Array:
        """Return where some skill may start, (k,) bool."""
        return np.asarray(self.may_start(obs).any(axis=1))

    def guided(self, memory: Memory, rows: Array, may: Array) -> Array:
        """Return which choices (k, choices) the guide leaves, as far as is known before it acts."""
        if self.guide is None or not self.guide.restricts:
            return may
        left: Array = self.guide.selector.ahead(memory["guide"], rows, may)
        return left

    def stuck(self, memory: Memory, rows: Array, obs: Array) -> Array:
        """(k,) bool, the selector must decide, but no skill may start; its own call ends there."""
        stuck = np.zeros(len(rows), bool)
        end = memory["end"][rows]
        waits = np.flatnonzero((end != RUNNING) & (end != EPISODE))
        if len(waits):
            stuck[waits] = ~self.startable(obs[waits])
        return stuck

    def check_lengths(self, memory: Memory, longest: int) -> None:
        """Raise a SkillError where a call has run for ``longest`` steps: nothing may end it."""
        steps = memory["elapsed"]
        if steps.max() >= longest:
            row = int(steps.argmax())
            raise SkillError(
                f"skill {self.skills[memory['skill'][row]].path!r} has run for {steps[row]:,} "
                f"steps in environment {row}, and neither its termination() nor the episode's end "
                "has come: give it max_steps, or the hierarchy call_steps"
            )

    # After a step -------------------------------------------------------------------------------

    def observe(self, memory: Memory, rows: Array, step: Step) -> None:
        """Notice a step of environments ``rows`` (k,): ``end`` says where calls ended, and why.

        Args:
            step: of these environments; ``elapsed`` counts as the caller does; each skill sees the
                time of its own call.
        """
        memory["elapsed"][rows] += 1
        elapsed, running = memory["elapsed"][rows], memory["skill"][rows]
        end = np.zeros(len(rows), np.int8)
        if self.lengths:
            end[elapsed >= memory["length"][rows]] = LIMIT
        end[elapsed >= self._limits[running]] = LIMIT
        own = own_step(step)

        def seen(i: int, mine: Array) -> Step:
            """Return the step as skill ``i`` sees it in ``rows[mine]``."""
            goal = self.goal_of(memory, i, rows[mine])
            return part_of(own, elapsed[mine], mine, self.skills[i].max_steps, goal)

        for i, mine in _by_skill(running):
            if i not in self._asked:
                continue
            skill = self.skills[i]
            at = rows[mine]
            part = seen(i, mine)
            if skill.policy.watches:
                skill.policy.observe(memory[str(i)], at, part)
                if skill.policy.restricts:
                    end[mine[skill.policy.stuck(memory[str(i)], at, part.next_obs)]] = LIMIT
            if skill.termination is not None:
                end[
                    mine[self.call_user(skill.termination, part, at, skill.path, "termination")]
                ] = OWN
        if self._fades is not None:
            self._watch_before(memory, rows, own)
        if self.interruption is not None:
            self._interrupt(self.interruption, memory, rows, step, end)
        end_with_episode(end, step.terminated | step.truncated)
        memory["end"][rows] = end
        if not any(who.ends_matter for who in self._ready.values()):
            return
        succeeded = end == OWN  # where the skill does not say it itself
        ended = np.flatnonzero(end != RUNNING)
        for i, mine in _by_skill(running[ended]):
            skill = self.skills[i]
            over = ended[mine]
            if skill.success is not None:
                part = seen(i, over)
                succeeded[over] = self.call_user(
                    skill.success, part, rows[over], skill.path, "success"
                )
        for name, who in self._ready.items():
            who.watch(memory[name], rows, step, LastCall(running, end, succeeded))

    def _watch_before(self, memory: Memory, rows: Array, own: Step) -> None:
        """Let the policies of skills that fade out notice a step, as one of their own call."""
        before = memory["before"][rows]
        fading = np.flatnonzero(before >= 0)
        memory["before_elapsed"][rows[fading]] += 1
        for i, some in _by_skill(before[fading]):
            skill = self.skills[i]
            if not skill.policy.watches:
                continue
            mine = fading[some]
            at = rows[mine]
            elapsed = memory["before_elapsed"][at]
            seen = part_of(own, elapsed, mine, skill.max_steps, self.goal_of(memory, i, at))
            skill.policy.observe(memory[str(i)], at, seen)

    def _interrupt(
        self, how: Interruption, memory: Memory, rows: Array, step: Step, end: Array
    ) -> None:
        """End running calls where a new decision is worth clearly more, in place.

        What a call is worth is that of its skill with its goal.
        """
        mine = np.flatnonzero(end == RUNNING)
        if not len(mine):
            return
        rows = rows[mine]
        obs = step.next_obs[mine]
        n = len(self.skills)
        running = memory["skill"][rows]
        seen = obs
        if self.fresh_calls:
            seen = joined(obs, step.goal[mine])
        if self.goals:
            goals = {i: memory["goal"][str(i)][rows] for i in self.goals}
            seen = self.beside_calls(seen, running, goals)
        worth = how.worth(seen)
        # Where no skill could be called, a new decision is worth nothing.
        again = np.where(self.startable(obs), worth[:, n], -np.inf)
        end[mine[again - worth[np.arange(len(rows)), running] > how.margin]] = INTERRUPTED

    def check(self, sees: Space, acts: Space, goal: Space | None, where: str) -> None:
        """Check that the selector, the guide, the critic and all skills fit."""
        names = [skill.name for skill in self.skills]
        if not names or len(set(names)) < len(names):
            raise PolicyError(f"{where}.skills are {names}; they must have names of their own")
        if self._fades is not None and acts.kind != "Box":
            raise PolicyError(f"{where}: fades need actions of a Box, but they are of {acts}")
        seen = sees if goal is None or not self.fresh_calls else with_goal(sees, goal)
        choice = plain = discrete(self.choices)
        spaces = {self.skills[i].name: own.space for i, own in self.goals.items()}
        if spaces:
            of = Space("Dict", parts=spaces)
            choice = Space("Dict", parts={SKILL: plain, GOAL: of})
        if self.selector is None:
            raise PolicyError(f"{where} has no selector")
        if self.fresh_calls and goal is None:
            raise PolicyError(f"{where}.fresh_calls is true, but its calls have no goals")
        if self.interruption is not None and not self.interruption.margin >= 0:
            margin = self.interruption.margin
            raise PolicyError(f"{where}.interruption.margin is {margin}; it must be at least 0")
        if isinstance(self.selector, Selector):
            self.selector.check_skills(names, choice, f"{where}.selector")
        self.selector.check(seen, choice, None, f"{where}.selector")
        if self.guide is not None:
            if not isinstance(self.guide.selector, Selector):
                kind = type(self.guide.selector).__name__
                raise PolicyError(f"{where}.guide is a {kind}; it must be a ready selector")
            self.guide.selector.check_skills(names, None, f"{where}.guide")
            self.guide.selector.check(seen, plain, None, f"{where}.guide")
        if self.interruption is not None and isinstance(self.interruption.worth, Critic):
            least = np.asarray(-np.inf)
            most = np.asarray(np.inf)
            worth = Space("Box", "float32", (len(self.skills) + 1,), least, most)
            seen = with_goal(seen, of) if spaces else seen
            self.interruption.worth.policy.check(seen, worth, None, f"{where}.critic")
        for i, skill in enumerate(self.skills):
            own = None if skill.goals is None else skill.goals.space
            skill.policy.check(sees, acts, own, f"{where}.skills[{i}].policy")


def _by_skill(running: Array) -> Iterator[tuple[int, Array]]:
    """Yield the skills that act, in order, and where they run in ``running`` (k,)."""
    present = sorted(set(running.tolist()))
    if len(present) == 1:
        yield present[0], np.arange(len(running))
        return
    for i in present:
        yield i, np.flatnonzero(running == i)


def unless_none(may: Array) -> Array:
    """Return choices that may be made, (k, choices) bool; all where none may."""
    return may | ~may.any(axis=1, keepdims=True)
