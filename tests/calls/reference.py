"""What a call means, in plain Python: one environment, one step after another.

Nothing here uses the policies, the player or the collectors that are compared with it.
Observations, actions and goals are as the environment has them, of a Dict a dict.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from calls.worlds import (
    ACTIONS,
    Chooser,
    World,
    WorldLevel,
    WorldSkill,
    Worths,
    as_goal,
    choice_counts,
    leaves,
    network,
    watching,
)
from gymnasium.spaces import Dict

from skillweave.policies.core import CallEnd
from skillweave.types import Array, Memory

RUNNING, OWN, LIMIT, INTERRUPTED, EPISODE = CallEnd
TRIES = 16
Choices = list[tuple[int, Any]]
"""Numbers, and the goals of the skills, where they have some."""


def row(x: Any) -> Any:
    """One observation, action or goal as a batch of one; of a dict each part."""
    return {k: row(v) for k, v in x.items()} if isinstance(x, dict) else np.asarray(x)[None]


def only(x: Any) -> Any:
    """The only one of a batch of one."""
    return {k: only(v) for k, v in x.items()} if isinstance(x, dict) else x[0]


@dataclass
class Shown:
    """A step as skills and policies see it, in batches of one."""

    obs: Any
    action: Any
    next_obs: Any
    reward: Array
    terminated: Array
    truncated: Array
    timed_out: Array
    elapsed: Array
    info: dict[str, Any]
    goal: Any = None
    """Of the call, where the skill has goals."""


@dataclass
class Moment:
    """One step of an episode."""

    obs: Any
    action: Any
    next_obs: Any
    reward: float
    terminated: bool
    truncated: bool
    acted: dict[str, Any]
    """By the names in a player's memory, what holds after the action."""
    observed: dict[str, Any]
    """The same after the step."""
    decision: Decision | None
    """Of the first selector."""
    ahead: list[bool]
    """The choices that may be made next, as far as is known before the next observation counts."""
    overridden: bool
    """A reflex acted, here or below."""

    @property
    def over(self) -> bool:
        """It is the episode's last."""
        return self.terminated or self.truncated


@dataclass
class Decision:
    choice: int
    mask: list[bool]
    before: dict[str, Any]
    """What the selector remembered."""
    chances: list[float] | None
    """The probabilities of the guide's choices."""


@dataclass
class Course:
    """What all levels share in an episode."""

    learns: str
    """Which selectors learn: "none", the "first" one, "all" that are trained; or "outside": the
    first one is asked once for each call."""
    last: Any
    """The environment's last action."""
    seen: Counter[str] = field(default_factory=Counter)
    """How often something happened that the worlds are to show."""


# Parts ------------------------------------------------------------------------------------------


def seen_by(sees: str | None, obs: Any) -> Any:
    """What a skill sees of an observation."""
    arm, hook, mode = obs["arm"], obs["hook"], np.eye(3)[obs["mode"]]
    inputs = {
        None: obs,
        "arm": arm,
        "two": np.concatenate([hook, mode]),
        "named": {"a": np.concatenate([arm, hook / 2]), "b": mode},
        "computed": arm + arm,
        "scaled": np.concatenate([np.clip((arm[::-1] - 0.5) * 2, -1, 1), hook]),
    }
    return inputs[sees]


def own_mask(skill: WorldSkill, mask: Array | None) -> Array | None:
    """The part of a mask that is for what a skill writes."""
    if mask is None or skill.acts is None:
        return mask
    ends = np.cumsum(choice_counts(ACTIONS[skill.kind]))
    each = [mask[[place]] for place in range(ends[-1])]
    if skill.kind == "several":
        each = np.split(mask, ends[:-1])
    return np.concatenate([each[place] for place in skill.acts])


def own_action(skill: WorldSkill, action: Any) -> Any:
    """The part of an environment's action that a skill writes."""
    if skill.acts is None:
        return action
    if skill.kind == "one":  # a choice that it does not have is told as its first
        return skill.acts.index(action - 1) if action - 1 in skill.acts else 0
    if skill.kind == "named":
        parts = {name: action[name] for name in skill.acts}
        return parts if len(parts) > 1 else parts[skill.acts[0]]
    return np.asarray(action)[list(skill.acts)]


def whole_action(skill: WorldSkill, own: Any, rest: Any, last: Any) -> Any:
    """The environment's action of a skill's own one; ``rest`` says the other numbers."""
    if skill.acts is None:
        return own
    if skill.kind == "one":
        return skill.acts[own] + 1
    action = resting(rest, ACTIONS[skill.kind], last)
    if skill.kind == "named":
        return action | (own if len(skill.acts) > 1 else {skill.acts[0]: own})
    action[list(skill.acts)] = own
    return action


def resting(rest: Any, space: Any, last: Any) -> Any:
    """The numbers that no skill writes: zero, those of the last action, or fixed ones."""
    if isinstance(space, Dict):
        parts = rest if isinstance(rest, dict) else dict.fromkeys(space, rest)
        before = last or dict.fromkeys(space)
        return {k: resting(parts.get(k, "zero"), space[k], before[k]) for k in space}
    size = int(np.prod(space.shape))
    entries = rest if isinstance(rest, list) else [rest] * size
    values = np.zeros(size, space.dtype)
    for i, entry in enumerate(entries):
        if entry == "hold":
            values[i] = np.reshape(last, -1)[i]
        elif entry != "zero":
            values[i] = entry
    return values.reshape(space.shape)


def corrected(skill: WorldSkill, base: Array, learnt: Array) -> Array:
    """A ready policy's action with a correction, within the bounds; scales are of half a range."""
    space = skill.action_space
    half = np.float64(space.high - space.low) / 2
    both = np.float64(base) + half * np.array(skill.scale) * np.float64(learnt)
    return np.clip(both, space.low, space.high).astype(np.float32)


# Calls ------------------------------------------------------------------------------------------


class Ready:
    """A ready selector."""

    def __init__(self, level: WorldLevel, kind: str) -> None:
        self.level, self.kind = level, kind
        self.state, self.last = 0, (-1, EPISODE, False)

    def allowed(self, obs: Any) -> list[int]:
        """The skills that it may choose, best first; ``obs`` None: as far as it knows before."""
        if self.kind == "automaton":
            return self.level.machine.states[self.state]
        if obs is None:
            return [*range(len(self.level.skills))]
        last = SimpleNamespace(**{k: np.array(v) for k, v in self.remembered().items()})
        given = last if self.kind == "last" else None
        return [int(self.level.by_function(row(obs), given)[0])]

    def watch(self, step: Shown, last: tuple[int, int, bool]) -> None:
        self.last = last
        _, why, succeeded = last
        ended = {"success": succeeded, "failure": not succeeded}
        machine = self.level.machine
        for origin, target, name in machine.arrows:
            if origin != self.state:
                continue
            event = machine.events[name]
            if bool(event(step)[0]) if callable(event) else (why != RUNNING and ended[event]):
                self.state = target
                return

    def remembered(self) -> dict[str, Any]:
        if self.kind == "automaton":
            return {"state": self.state}
        keys = ("skill", "why", "succeeded")
        return dict(zip(keys, self.last, strict=True)) if self.kind == "last" else {}


class Life:
    """The calls of one level, from the start of an episode, or of a call of the whole.

    Args:
        learns: its selector does.
        choices: of a user that chooses by itself; the latest are taken first. None: the selector
            chooses.
    """

    def __init__(
        self, level: WorldLevel, course: Course, learns: bool, choices: Choices | None = None
    ) -> None:
        self.level, self.course, self.learns, self.choices = level, course, learns, choices
        self.lengths = level.lengths or (None,)
        self.skill, self.elapsed, self.end, self.length = -1, 0, EPISODE, None
        self.chances: list[float] | None = None
        self.part: Any = None  # of the running skill: a Life, or what its policy remembers
        self.base: Memory = {}  # what the policy remembers that the running skill corrects
        self.goal: Any = None  # of the running call
        self.own_goal: Any = None  # of the call of the whole
        self.ready = Ready(level, level.selector) if level.ready else None
        guides = level.guide if learns or level.guide_restricts else None
        guides = guides if choices is None else None
        self.guide = None if guides is None else Ready(level, guides)
        self.net = None if level.ready else Chooser(level)
        self.memory = {} if self.net is None else self.net.start(1)
        self.decision: Decision | None = None
        self.once = False
        """Its selector is asked once for each call."""

    @property
    def running(self) -> WorldSkill:
        return self.level.skills[self.skill]

    def joined(self, obs: Any) -> Any:
        """What the selector sees."""
        return obs if self.own_goal is None else {"observation": obs, "goal": self.own_goal}

    # Decisions

    @staticmethod
    def startable(level: WorldLevel, obs: Any) -> list[bool]:
        found = []
        for case in level.skills:
            starts = case.methods.get("initiation")
            may = starts is None or bool(starts(row(obs))[0])
            found.append(may and (case.below is None or any(Life.startable(case.below, obs))))
        return found

    def decide(self, obs: Any, deterministic: bool) -> None:
        may, seen = self.startable(self.level, obs), self.course.seen
        if self.guide is not None:
            wanted = [k for k in self.guide.allowed(self.joined(obs)) if may[k]]
            share = [(k in wanted) / len(wanted) for k in range(len(may))]
            self.chances = [x / len(self.lengths) for x in share for _ in self.lengths]
            if self.level.guide_restricts:
                may = [k in wanted for k in range(len(may))]
        mask = [yes for yes in may for _ in self.lengths]
        greedy = deterministic and self.level.greedy_selector
        asks = self.net is not None and self.choices is None and not self.once
        again = asks and (self.learns or not greedy)
        before, tried = self.memory, list[int]()
        while True:
            number, goal = self.choice(before, obs, mask, greedy)
            skill, length = divmod(number, len(self.lengths))
            if not self.holds(self.level.skills[skill], obs, goal):
                break
            tried.append(skill)
            if not again or len(tried) == TRIES:
                break
        assert mask[number], "it may not start"
        remembered = {k: v[0].tolist() for k, v in before.items()}
        self.decision = Decision(number, mask, remembered, self.chances)
        seen["the same again, at last"] += len(tried) == TRIES
        seen["chosen again"] += len(tried) > 0 and again
        same = skill == self.skill
        seen["it goes on after a choice that was no call"] += same and bool({*tried} - {skill})
        seen["again at once" if same else "after another one"] += self.end != EPISODE
        seen["a mask of choices"] += not all(mask)
        anew = self.level.skills[skill].below is not None and goal is not None
        seen["a hierarchy anew"] += anew and same
        if not same or anew:
            self.part = self.fresh(skill)
        self.goal = goal
        if isinstance(self.part, Life):
            self.part.own_goal = goal
        self.skill, self.elapsed, self.end = skill, 0, RUNNING
        self.length = self.lengths[length]

    def choice(self, before: Memory, obs: Any, mask: list[bool], greedy: bool) -> tuple[int, Any]:
        """The number of a choice, and the goal of its skill, where that has some."""
        if self.choices is not None:
            return self.choices.pop()
        seen, goals = self.joined(obs), dict[str, Any]()
        if self.ready is None:
            named = [*leaves(row(seen), "obs")]
            (found, goals), self.memory = self.net.named(before, named, np.array([mask]), greedy)
            number = int(found[0])
        else:
            number = next(k for k in self.ready.allowed(seen) if mask[k])
        case = self.level.skills[number // len(self.lengths)]
        if case.goal is None:
            return number, None
        if self.ready is None:
            goal = only(goals[case.name])
        elif self.level.selector != "automaton":
            goal = only(self.level.given_goals(row(seen), [case.name], "function")[case.name])
        else:
            goal = self.level.goal_in_state(self.ready.state, case.name)
            self.course.seen["a fixed goal"] += not callable(goal)
            goal = only(goal(row(seen))) if callable(goal) else goal
        return number, only(case.clip_goal(row(obs), row(goal))) if case.clips else goal

    @staticmethod
    def holds(case: WorldSkill, obs: Any, goal: Any) -> bool:
        """The call would end at once, by its goal; as far as a step that stands still can say."""
        if goal is None or case.stops not in ("still", "often"):
            return False
        zero, no, here = np.zeros(1, np.float32), np.zeros(1, bool), row(obs)
        still = Shown(here, zero, here, zero, no, no, no, np.ones(1, np.int64), {}, row(goal))
        return bool(case.methods["termination"](still)[0])

    def fresh(self, skill: int) -> Life | Memory:
        """What a skill remembers where it has not acted."""
        case = self.level.skills[skill]
        unseen = {"seen": np.zeros((1, 1))}
        self.base = unseen if case.corrects == "watching" else {}
        if case.below is not None:
            return Life(case.below, self.course, self.course.learns == "all")
        if case.policy == "watching":
            return unseen
        return {"rnn": np.zeros((1, 1), np.float32)} if case.policy == "recurrent" else {}

    # Acting

    def act(self, obs: Any, mask: Array | None, deterministic: bool) -> Any:
        self.decision, self.overridden = None, False
        if self.end != RUNNING:
            self.decide(obs, deterministic)
        if isinstance(self.part, Life):
            action = self.part.act(obs, mask, self.level.greedy)
            self.overridden = self.part.overridden
        else:
            action = self.act_skill(obs, mask)
        for reflex in self.level.rules:
            if reflex.condition(row(obs))[0]:
                self.overridden = True
                answer: Any = reflex.action
                action = only(answer(row(obs))) if callable(answer) else answer
        return action

    def act_skill(self, obs: Any, mask: Array | None) -> Any:
        case, allowed = self.running, own_mask(self.running, mask)
        seen = row(seen_by(case.sees, obs))
        if case.policy in ("network", "recurrent"):
            given = seen if self.goal is None else {"observation": seen, "goal": row(self.goal)}
            masked = None if allowed is None else row(allowed)
            found, self.part = network(case).named(
                self.part, leaves(given, "obs"), masked, self.level.greedy
            )  # fmt: skip
        else:
            found = self.acts_ready(case.policy, "policy", self.part, seen)
        own = only(found)
        if case.corrects is not None:
            base = only(self.acts_ready(case.corrects, "base", self.base, seen))
            own = corrected(case, base, own)
        self.notice(case, mask)
        return whole_action(case, own, self.level.rest, self.course.last)

    def acts_ready(self, policy: str, what: str, memory: Memory, seen: Any) -> Any:
        case = self.running
        if policy == "watching":
            return watching(case, what).answer(memory, seen)
        goal = () if self.goal is None else (row(self.goal),)
        return case.function(what, case.action_space)(seen, *goal)

    # After a step

    def observe(self, step: Shown) -> None:
        """Notice a step, whose time is the caller's."""
        self.course.last = only(step.action)
        self.elapsed += 1
        case, own, next_obs = self.running, self.seen(step), only(step.next_obs)
        self.end = LIMIT if self.limited else RUNNING
        if isinstance(self.part, Life):
            below = self.part
            below.observe(own)
            waits = below.end not in (RUNNING, EPISODE)
            if waits and not any(self.startable(below.level, next_obs)):
                self.course.seen["stuck"] += not self.limited
                self.end = LIMIT  # nothing below could follow
        else:
            self.watch_skill(own)
        if "termination" in case.methods and case.methods["termination"](own)[0]:
            self.end = OWN
        if self.level.margin is not None and self.end == RUNNING:
            worth = self.worth(step)
            gain = worth[-1] - worth[self.skill]
            if any(self.startable(self.level, next_obs)) and gain > self.level.margin:
                self.end = INTERRUPTED
        if (step.terminated[0] or step.truncated[0]) and self.end != OWN:
            self.end = EPISODE
        succeeded = self.end == OWN
        if "success" in case.methods and self.end != RUNNING:
            succeeded = bool(case.methods["success"](own)[0])
        for who in (self.guide, self.ready):
            if who is not None:
                who.watch(step, (self.skill, self.end, succeeded))

    @property
    def limited(self) -> bool:
        """The running call has reached a limit."""
        case = self.running
        most = case.call_steps or self.level.call_steps
        limits = (self.length, case.max_steps, most if isinstance(most, int) else None)
        return any(limit is not None and self.elapsed >= limit for limit in limits)

    def seen(self, step: Shown) -> Shown:
        """The step with the time as the running skill counts it, and its goal."""
        limit = self.running.max_steps
        timed_out = limit is not None and self.elapsed >= limit and not step.terminated[0]
        goal = None if self.goal is None else row(self.goal)
        times = {"timed_out": np.array([timed_out]), "elapsed": np.array([self.elapsed])}
        return replace(step, **times, goal=goal)

    def watch_skill(self, own: Shown) -> None:
        """Let the policy of the running skill notice a step."""
        case = self.running
        if "watching" not in (case.policy, case.corrects):
            return
        obs, next_obs = (row(seen_by(case.sees, only(x))) for x in (own.obs, own.next_obs))
        action = row(own_action(case, only(own.action)))
        part: Any = replace(own, obs=obs, next_obs=next_obs, action=action)
        if case.policy == "watching":
            self.part = watching(case, "policy").observe(self.part, part)
        if case.corrects == "watching":
            self.base = watching(case, "base").observe(self.base, part)

    def worth(self, step: Shown) -> Array:
        """What a critic says of the calls after a step, and last of a new decision.

        It sees the goal of the running call; of other skills what stands for none.
        """
        seen = self.joined(only(step.next_obs))
        if self.level.goals:
            none = np.zeros((1, 3))
            goals = {k: only(as_goal(none, kind)) for k, kind in self.level.goals.items()}
            if self.goal is not None:
                goals[self.running.name] = self.goal
            seen = {"observation": seen, "goal": goals}
        return Worths(self.level).named(leaves(row(seen), "obs"))[0]

    def ahead(self, next_obs: Any) -> list[bool]:
        may = self.startable(self.level, next_obs)
        if self.guide is not None and self.level.guide_restricts:
            may = [yes and k in self.guide.allowed(None) for k, yes in enumerate(may)]
        if not any(may):
            may = [True] * len(may)
        return [yes for yes in may for _ in self.lengths]

    # What can be compared, and counted

    def remembered(self) -> dict[str, Any]:
        """What holds now, by the names in a player's memory: of what runs."""
        found = {"skill": self.skill, "elapsed": self.elapsed, "end": int(self.end)}
        if self.level.lengths:
            found["length"] = self.length
        own = "own." * (self.running.corrects is not None)
        below = [("base.", self.base)] if own else []
        if isinstance(self.part, Life):
            found |= {f"{self.skill}.{k}": v for k, v in self.part.remembered().items()}
        else:
            below.append((own, self.part))
        for prefix, memory in below:
            found |= {f"{self.skill}.{prefix}{k}": v[0].tolist() for k, v in memory.items()}
        if self.goal is not None and not isinstance(self.goal, dict):
            found[f"goal.{self.skill}"] = np.asarray(self.goal).tolist()
        if self.choices is None:
            selector = {k: v[0].tolist() for k, v in self.memory.items()}
            selector = selector if self.ready is None else self.ready.remembered()
            found |= {f"selector.{k}": v for k, v in selector.items()}
        if self.guide is not None:
            found |= {f"guide.{k}": v for k, v in self.guide.remembered().items()}
            found["chances"] = self.chances
        return found

    def notice(self, case: WorldSkill, mask: Array | None) -> None:
        """Count what acts."""
        level, seen = self.level, self.course.seen
        happens = {
            f"{level.kind} actions": True,
            f"a {case.policy} acts": True,
            f"a goal of {case.goal}": case.goal is not None,
            "a goal that is clipped": case.clips,
            "a hierarchy with a goal": self.own_goal is not None,
            f"a correction of a {case.corrects}": case.corrects is not None,
            f"sees {case.sees}": case.sees is not None,
            f"acts of {level.kind}": case.acts is not None,
            f"rests of {level.kind}: {level.rest}": case.acts is not None,
            "a mask": mask is not None,
            "a mask of a part": mask is not None and case.acts is not None,
            f"a {level.selector} selects": True,
            f"a {level.guide} guides": self.guide is not None,
            "a guide that restricts nothing": self.guide is not None and not level.guide_restricts,
            "a length is chosen": bool(level.lengths),
            "three levels": level.path.count("/") == 2,
            "a skill samples": not level.greedy,
            "a critic that sees goals": level.margin is not None and bool(level.goals),
        }
        seen.update(name for name, yes in happens.items() if yes)


def episode(
    world: World,
    seed: int,
    learns: str = "none",
    seen: Counter[str] | None = None,
    choices: Choices | None = None,
) -> list[Moment]:
    """An episode from its seed; what happens is counted in ``seen``.

    Args:
        learns: see ``Course``.
        choices: of the first selector; those that it did not come to are left out.
    """
    rests = resting("zero", ACTIONS[world.level.kind], None)
    course = Course(learns, rests, Counter() if seen is None else seen)
    choices = None if choices is None else choices[::-1]
    life = Life(world.level, course, learns in ("first", "all"), choices)
    life.once = learns == "outside"
    return [*lived(life, world, seed)]


def lived(life: Life, world: World, seed: int) -> Iterator[Moment]:
    """The steps of an episode."""
    env = world.env()
    obs, info = env.reset(seed=seed)
    over, t = False, 0
    while not over:
        if life.choices == [] and life.end != RUNNING:
            return  # the user has come no further
        action = life.act(obs, info.get("action_mask"), world.deterministic)
        acted, decision = life.remembered(), life.decision
        next_obs, reward, terminated, truncated, info = env.step(action)
        over, t = terminated or truncated, t + 1
        truncated = truncated and not terminated  # as engines say it
        step = Shown(
            row(obs), row(action), row(next_obs), np.array([reward], np.float32),
            np.array([terminated]), np.array([truncated]), np.zeros(1, bool), np.array([t]),
            {k: np.array([v]) for k, v in info.items() if k == "t"},
        )  # fmt: skip
        life.observe(step)
        yield Moment(
            obs, action, next_obs, float(step.reward[0]), terminated, truncated, acted,
            life.remembered(), decision, life.ahead(next_obs), life.overridden,
        )  # fmt: skip
        obs = next_obs


@dataclass
class Call:
    """A decision of the first selector and the call that followed."""

    decision: Decision
    moments: list[Moment]
    first: bool
    """Of its episode."""


def calls(moments: list[Moment]) -> list[Call]:
    """The calls of an episode that is over."""
    found: list[Call] = []
    for moment in moments:
        if moment.decision is not None:
            found.append(Call(moment.decision, [], not found))
        found[-1].moments.append(moment)
    return found
