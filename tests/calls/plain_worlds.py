"""What goals, own parts, corrections and the rest of an action mean, in plain Python.

As in ``reference``: one environment, one step after another, and nothing that lets skills act.
Observations, actions and goals are as the environment has them, of a Dict a dict.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from calls.reference import EPISODE, RUNNING, Life, Moment, Shown, lived, only, row
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

from skillweave.types import Array, Memory

TRIES = 16


@dataclass
class Course:
    """What all levels share in an episode."""

    learns: str
    """Which selectors learn: "none", the "first" one, or "all" that are trained."""
    last: Any
    """The environment's last action."""
    seen: Counter[str] = field(default_factory=Counter)
    """How often something happened that the worlds are to show."""


def episode(
    world: World, seed: int, learns: str = "none", seen: Counter[str] | None = None
) -> list[Moment]:
    """An episode from its seed; what happens is counted in ``seen``.

    Args:
        learns: see ``Course``.
    """
    course = Course(learns, resting("zero", ACTIONS[world.level.kind], None))
    if seen is not None:
        course.seen = seen
    life = WorldLife(world.level, course, learns != "none")
    return [*lived(life, world, seed)]


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


class WorldLife(Life):
    """The calls of one level of a world.

    Args:
        learns: its selector does.
        goal: of the call of the whole, where it is a skill that has goals.
    """

    def __init__(
        self, level: WorldLevel, course: Course, learns: bool = False, goal: Any = None
    ) -> None:
        super().__init__(level)
        self.course, self.learns, self.own_goal = course, learns, goal
        self.goal: Any = None  # of the running call
        self.base: Memory = {}  # what the policy remembers that the running skill corrects

    @property
    def running(self) -> WorldSkill:
        return self.level.skills[self.skill]

    def network(self) -> Chooser:
        return Chooser(self.level)

    def joined(self, obs: Any) -> Any:
        """What the selector sees."""
        return obs if self.own_goal is None else {"observation": obs, "goal": self.own_goal}

    # Decisions

    def decide(self, obs: Any, deterministic: bool) -> None:
        may = self.startable(self.level, obs)
        mask = [yes for yes in may for _ in self.lengths]
        greedy = deterministic and self.level.greedy_selector
        again = self.net is not None and (self.learns or not greedy)
        before, tried = self.memory, list[int]()
        while True:
            number, goals = self.choice(before, self.joined(obs), mask, greedy)
            skill, length = divmod(number, len(self.lengths))
            case = self.level.skills[skill]
            goal = goals.get(case.name)
            if case.clips:
                goal = only(case.clip_goal(row(obs), row(goal)))
            if not self.holds(case, obs, goal):
                break
            tried.append(skill)
            if not again or len(tried) == TRIES:
                break
        self.course.seen["the same again, at last"] += len(tried) == TRIES
        self.course.seen["chosen again"] += len(tried) > 0 and again
        assert mask[number], "it may not start"
        goes_on = skill == self.skill and bool({*tried} - {skill})
        self.course.seen["it goes on after a choice that was no call"] += goes_on
        anew = case.below is not None and goal is not None
        self.course.seen["a hierarchy anew"] += anew and skill == self.skill
        if skill != self.skill or anew:
            self.part = self.fresh(skill)
        self.goal = goal
        if isinstance(self.part, WorldLife):
            self.part.own_goal = goal
        self.begin(skill, length)

    def choice(
        self, before: Memory, seen: Any, mask: list[bool], greedy: bool
    ) -> tuple[int, dict[str, Any]]:
        """The number of a choice, and goals by the names of skills."""
        if self.ready is None:
            named = [*leaves(row(seen), "obs")]
            (number, goals), self.memory = self.net.named(before, named, np.array([mask]), greedy)
            return int(number[0]), only(goals)
        number = next(k for k in self.ready.allowed(seen) if mask[k])
        name = self.level.skills[number].name
        if name not in self.level.goals:
            return number, {}
        if self.level.selector != "automaton":
            return number, only(self.level.given_goals(row(seen), [name], "function"))
        goal = self.level.goal_in_state(self.ready.state, name)
        self.course.seen["a fixed goal"] += not callable(goal)
        return number, {name: only(goal(row(seen))) if callable(goal) else goal}

    @staticmethod
    def holds(case: WorldSkill, obs: Any, goal: Any) -> bool:
        """The call would end at once, by its goal; as far as a step that stands still can say."""
        if goal is None or case.stops not in ("still", "often"):
            return False
        zero, no, here = np.zeros(1, np.float32), np.zeros(1, bool), row(obs)
        still = Shown(here, zero, here, zero, no, no, no, np.ones(1, np.int64), {}, row(goal))
        return bool(case.methods["termination"](still)[0])

    def fresh(self, skill: int) -> Life | Memory:
        case = self.level.skills[skill]
        unseen = {"seen": np.zeros((1, 1))}
        self.base = unseen if case.corrects == "watching" else {}
        if case.below is not None:
            return WorldLife(case.below, self.course, self.course.learns == "all")
        if case.policy == "watching":
            return unseen
        return {"rnn": np.zeros((1, 1), np.float32)} if case.policy == "recurrent" else {}

    # Steps

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

    def observe(self, step: Shown) -> None:
        self.course.last = only(step.action)
        super().observe(step)
        if self.running.below is not None:
            nothing = not any(self.startable(self.running.below, only(step.next_obs)))
            waits = self.part.end not in (RUNNING, EPISODE)
            self.course.seen["stuck"] += nothing and waits and not self.limited

    def seen(self, step: Shown) -> Shown:
        return replace(super().seen(step), goal=None if self.goal is None else row(self.goal))

    def watch_skill(self, own: Shown) -> None:
        case = self.running
        if "watching" not in (case.policy, case.corrects):
            return
        obs, next_obs = (row(seen_by(case.sees, only(x))) for x in (own.obs, own.next_obs))
        action = row(own_action(case, only(own.action)))
        part = replace(own, obs=obs, next_obs=next_obs, action=action)
        if case.policy == "watching":
            self.part = watching(case, "policy").observe(self.part, part)
        if case.corrects == "watching":
            self.base = watching(case, "base").observe(self.base, part)

    def worth(self, step: Shown) -> Array:
        """A critic sees the goal of the running call; of other skills what stands for none."""
        seen = self.joined(only(step.next_obs))
        if self.level.goals:
            none = np.zeros((1, 3))
            goals = {k: only(as_goal(none, kind)) for k, kind in self.level.goals.items()}
            if self.goal is not None:
                goals[self.running.name] = self.goal
            seen = {"observation": seen, "goal": goals}
        return Worths(self.level).named(leaves(row(seen), "obs"))[0]

    # What can be compared, and counted

    def remembered(self) -> dict[str, Any]:
        found = super().remembered()
        if self.level.skills[self.skill].corrects is not None:
            own = f"{self.skill}."
            found = {k.replace(own, f"{own}own.", 1) if k.startswith(own) else k: v
                     for k, v in found.items()}  # fmt: skip
        if self.goal is not None and not isinstance(self.goal, dict):
            found[f"goal.{self.skill}"] = np.asarray(self.goal).tolist()
        return found | {f"{self.skill}.base.{k}": v[0].tolist() for k, v in self.base.items()}

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
            "a length is chosen": bool(level.lengths),
            "three levels": level.path.count("/") == 2,
            "a skill samples": not level.greedy,
            "a critic that sees goals": level.margin is not None and bool(level.goals),
        }
        seen.update(name for name, yes in happens.items() if yes)
