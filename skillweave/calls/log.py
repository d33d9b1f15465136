"""The calls of skills as arrays, with all steps inside each call."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.policy_protocol import Policy
from skillweave.calls.call_file import read_calls, write_calls
from skillweave.calls.columns import columns_of, fields_of
from skillweave.calls.handover import LinkedCalls
from skillweave.calls.neighbors import FEATURES
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError, RunError
from skillweave.policies.untrusted import checksum
from skillweave.runs.user_code import (
    Texts,
    changes,
    environment_texts,
    notice_changes,
    skill_texts,
)
from skillweave.skills.foreign_policy import source_of
from skillweave.skills.goal_spaces import without_goal
from skillweave.skills.own_part import OwnPart
from skillweave.skills.skill_set import SkillSet, skills_below
from skillweave.spaces import obs_codec, same_space

LEARNING = "learning"
"""In place of a checksum: the skill learnt while its calls were recorded."""


class CallLog(LinkedCalls):
    """C calls of skills, in the order of their starts, and the T steps inside them.

    Attributes:
        skills: names of the skills.
        lengths: lengths that were chosen with the skills; empty: none were.
        checksums: of each skill, what decides its actions and its ends.
        sees: of each skill, the places in the flat observation that its network sees; None: all.
        recurrent: of each skill, whether its policy has a memory within a call.
        own_success: of each skill, whether it defines ``success``.
        observation_space: of the environment.
        action_space: of the environment.
        start: (C, *obs_shape), the observation of the decision.
        choice: (C,) int64, the skill's place in ``skills``; with lengths, that times their number
            plus the length's place.
        end_reason: (C,) int8, ``CallEnd``: by itself, at a limit, interrupted, with the episode.
        succeeded: (C,) bool, the skill's ``success`` at the end; without one, ended by itself.
        terminated: (C,) bool, the episode ended in the call.
        truncated: (C,) bool, the episode's time limit cut the call.
        episode: (C,) int64, the number of the episode.
        seed: (C,) int64, the seed of the episode, from which its environment repeats it with the
            same actions; −1: unknown, of EnvPool.
        order: (C,) int64, the call's number in its episode, from 0.
        age: (C,) int64, the steps of the episode before the call.
        may_follow: (C, choices) bool, the choices that may start at the call's end.
        offset: (C + 1,) int64, the first step of each call; its last one is before the next call's.
        next_obs: (T, *obs_shape), the observation after each step.
        action: (T, *action_shape).
        reward: (T,) float32, the environment's.
        info: by key, (T, …) values of the environment's ``info``.
        goals: by skill that has goals, (C, G) float64, the numbers of its calls' goals; in rows of
            other skills they mean nothing.
        code: texts of the environment and the skills, to be compared later.
        limits: of each skill, the most steps of a call; None: it has no limit. (): unknown.
        known_time_limit: ``time_limit`` of the log that these calls were taken from; None: of none.
        features: by what calls are compared where no others are given: the ``Hierarchy``'s, in the
            logs of its runs. Files do not have them.
    """

    def check_skills(self, skills: SkillSet, *, learning: bool = False) -> None:
        """Raise a RunError where the log is of other skills, spaces or limits of calls.

        Args:
            learning: allow a log in which skills learnt while their calls were recorded.
        """
        names = tuple(s.name for s in skills.skills)
        lengths = skills.lengths
        if names != self.skills:
            raise RunError(
                f"the log is of the skills {', '.join(self.skills)}, but these are "
                f"{', '.join(names)}; record a log of these skills"
            )
        if lengths != self.lengths:
            raise RunError(
                f"the log is of calls with {_shown_lengths(self.lengths)}, but these are with "
                f"{_shown_lengths(lengths)}; record a log of these calls"
            )
        for i, (skill, policy) in enumerate(zip(skills.skills, skills.policies, strict=True)):
            if (part := skills.part(i)) is not None:
                self.check_spaces(part.whole_observation_space, part.whole_action_space)
                continue
            seen = policy.observation_space
            seen = seen if skill.goal_space is None else without_goal(seen)
            self.check_spaces(seen, policy.action_space)
        if learning and LEARNING in self.checksums:
            return
        for name, now, then in zip(names, skill_checksums(skills), self.checksums, strict=True):
            if now != then:
                raise RunError(
                    f"the skill {name!r} has changed since the log was recorded (it has learnt on, "
                    "or its limits are others), so its calls end elsewhere now; record a new log"
                )
        if says := changes(self.code, skill_code(skills)):
            raise RunError(
                f"{says} since the log was recorded, so calls end elsewhere now; record a new log"
            )

    def check_environment(self, spec: EnvSpec) -> None:
        """Give a notice where the log is of another environment, or the environment has changed."""
        notice_changes(self.code, environment_texts(spec), "the log of calls was recorded")

    def check_spaces(self, observation: gym.Space[Any], action: gym.Space[Any]) -> None:
        """Raise a RunError where the log is of other spaces."""
        for what, own, other in (
            ("observations", self.observation_space, observation),
            ("actions", self.action_space, action),
        ):
            if not same_space(own, other):
                raise RunError(
                    f"the log has {what} of {own}, but here they are of {other}; record a log in "
                    "this environment"
                )

    def save(self, path: str | Path) -> None:
        """Write the log into one file, ``.safetensors``.

        Raises:
            RunError: the file cannot be written.
        """
        write_calls(path, self)

    @staticmethod
    def load(path: str | Path) -> CallLog:
        """Read a log; nothing in the file is executed.

        Raises:
            RunError: the file is missing or damaged, or holds no log of calls.
        """
        return CallLog(**read_calls(path))


@checked_names
def join(logs: Iterable[CallLog]) -> CallLog:
    """Return one log of several, whose episodes are numbered one after another.

    Raises:
        DeclarationError: no log is given.
        RunError: the logs are of other skills, spaces or ``info`` keys.
    """
    if isinstance(logs, CallLog):
        raise DeclarationError("join() takes a list of logs: join([log, other])")
    logs = list(logs)
    if not logs:
        raise DeclarationError("join() needs at least one log")
    first = logs[0]
    for log in logs[1:]:
        if (log.skills, log.lengths) != (first.skills, first.lengths):
            raise RunError(
                f"one log is of the skills {', '.join(first.skills)}, another of "
                f"{', '.join(log.skills)}, or of other lengths; join logs of the same skills"
            )
        first.check_spaces(log.observation_space, log.action_space)
        for name, a, b in zip(first.skills, first.checksums, log.checksums, strict=True):
            if a != b:
                raise RunError(
                    f"the skill {name!r} differs between the logs: it has learnt in between, or "
                    "its limits are others; join logs of the same skills"
                )
        if says := changes(first.code, log.code):
            raise RunError(
                f"between the logs, {says}; join logs of the same environment and skills"
            )
        if log.own_success != first.own_success:
            raise RunError(
                "of one log the skills' success() was known, of another not (its run was loaded "
                "without their code); record both with it"
            )
        if log.limits and first.limits and log.limits != first.limits:
            raise RunError(
                "the limits of calls (call_steps, max_steps) differ between the logs; join logs of "
                "the same skills"
            )
        if {k: v.shape[1:] for k, v in log.goals.items()} != {
            k: v.shape[1:] for k, v in first.goals.items()
        }:
            raise RunError("the skills have other goals in one log; join logs of the same skills")
        if log.info.keys() != first.info.keys():
            raise RunError(
                f"one log has the info keys {', '.join(first.info) or 'none'}, another "
                f"{', '.join(log.info) or 'none'}; record the same keys"
            )
    episodes, next_episode = [], 0
    for log in logs:
        episodes.append(log.episode + next_episode)
        next_episode = int(episodes[-1].max(initial=next_episode - 1)) + 1
    every = [columns_of(log) for log in logs]
    columns = {name: np.concatenate([of[name] for of in every]) for name in every[0]}
    columns["episode"] = np.concatenate(episodes)
    columns["offset"] = np.cumsum(np.concatenate([[0], *(log.tau for log in logs)]))
    limit = max(log.time_limit for log in logs)
    longer = any((log.age + log.tau).max(initial=0) > limit for log in logs)
    limits = next((log.limits for log in logs if log.limits), ())
    known = 0 if longer else limit
    return replace(first, **fields_of(columns), limits=limits, known_time_limit=known)


def skill_checksums(skills: SkillSet, learning: Collection[str] = ()) -> tuple[str, ...]:
    """Return a checksum of each skill: its policy, the limit of its calls, and the reflexes.

    Args:
        learning: names of the skills that learn while their calls are recorded.
    """
    checksums = []
    for i, policy in enumerate(skills.policies):
        if skills.skills[i].name in learning:
            checksums.append(LEARNING)
            continue
        source = source_of(policy)
        # A script is "__main__" while it runs, and has its own name where it is read as a recipe.
        acts = source.sha256 or str(source.name).partition(".")[2]
        reflexes = [reflex.name for reflex in skills.reflexes]
        goals = skills.skills[i].goal_space
        own = [] if goals is None else [str(goals)]
        if (part := skills.part(i)) is not None:
            own.append(str(part.to_json()))
        whole = repr([acts, skills.limit(i), skills.greedy, reflexes, *own])
        checksums.append(checksum(whole.encode()))
    return tuple(checksums)


def skill_code(skills: SkillSet) -> Texts:
    """Return the code of skills that decides how their calls start and end."""
    return skill_texts({s.name: s for s in skills.skills}, skills.reflexes, without="reward")


def seen_places(skills: SkillSet) -> tuple[tuple[int, ...] | None, ...]:
    """Return the places of the environment's observation that each skill's network sees.

    None: all, or the policy is no network, or the skill corrects a policy, which sees all, or sees
    its own part of observations; of one that has images, the part's places if it has none.
    """
    found: list[tuple[int, ...] | None] = []
    for i, (skill, policy) in enumerate(zip(skills.skills, skills.policies, strict=True)):
        part = skills.part(i)
        places = getattr(policy, "seen_places", None)
        if part is not None and (part.part.inputs is not None or part.base is not None):
            found.append(None if part.base is not None else _places_of_part(part))
            continue
        if places is None:
            found.append(None)
            continue
        if skill.goal_space is not None:  # goals come after the observation
            size = obs_codec(without_goal(policy.observation_space)).size
            places = tuple(place for place in places if place < size)
        found.append(places or None)
    return tuple(found)


def lacking_features(
    features: Any, space: gym.Space[Any], policy: Policy, skill: str | None = None
) -> str:
    """Return a sentence if skills see images, by which calls cannot be compared; it may be empty.

    Args:
        features: the hierarchy's.
        space: of the observations.
        policy: with the skills, of the whole hierarchy or of one level.
        skill: the name of the one that counts; None: all do.
    """
    skills = skills_below(policy)
    if skills is None or not obs_codec(space).images:
        return ""
    for one, places in zip(skills.skills, seen_places(skills), strict=True):
        own = features.get(one.name) if isinstance(features, Mapping) else features
        if places is None and own is None and skill in (None, one.name):
            return f"calls of {one.name!r} cannot be compared by images; {FEATURES}"
    return ""


def _places_of_part(part: OwnPart) -> tuple[int, ...] | None:
    """Return the places in the flat observation that a skill's own part has.

    None: there are no images, which would have no places; or it has one, or what a function makes.
    """
    codec = obs_codec(part.whole_observation_space)
    if not codec.images:
        return None
    leaves = dict[str, range]()
    first = 0
    for leaf in codec.leaves:
        if leaf.image is None:
            leaves[leaf.name] = range(first, first + leaf.size)
            first += leaf.size
    places = set[int]()
    for take in (take for one in (part.part.inputs or {}).values() for take in one.takes):
        own = leaves.get(".".join(take.fields)) if take.source == "observation" else None
        if own is None:
            return None
        one_hot = bool(take.choices) == (len(own) != prod(take.shape))
        places |= {own[i] for i in take.places} if take.places and one_hot else set(own)
    return tuple(sorted(places)) or None


def _shown_lengths(lengths: Sequence[int]) -> str:
    return f"the lengths {', '.join(map(str, lengths))}" if lengths else "no chosen lengths"
