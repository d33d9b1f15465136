"""Begin from data: the policies from which the learners of a new run start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.spaces import Dict, Tuple

from skillweave._internal.messages import short
from skillweave._internal.paths import AGENT
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.batches import INFO
from skillweave.algorithms.config import PPO, config_from_json, is_offline
from skillweave.algorithms.registry import make_algorithm
from skillweave.buffers.judged import JudgedStore
from skillweave.buffers.recorded_steps import MASK, RecordedSteps
from skillweave.data.cloning import Clone, clone
from skillweave.data.dataset import Dataset
from skillweave.data.segmenting import Segments, segment
from skillweave.data.timeline import Cuts
from skillweave.envs.make import make_engine
from skillweave.errors import DeclarationError
from skillweave.experience.views import learner_obs, own_actions
from skillweave.hierarchy.roles import roles_of
from skillweave.policies.core import Array
from skillweave.runs.initial_policies import Learnt, options_of
from skillweave.runs.manifest import Manifest
from skillweave.skills.goals import goals_of
from skillweave.skills.learnable import Learnable
from skillweave.spaces import action_codec
from skillweave.training.replay_learner import judge_of, store_of
from skillweave.training.role import Role

FEWEST = 20
"""The fewest rows from which a learner is cloned."""
DIFFERENT = 0.01
"""The share of steps whose rewards may differ when they are computed again."""


@dataclass(frozen=True)
class Beginning:
    """What a run begins with."""

    learnt: dict[str, Learnt]
    """The policies from which learners start, by name."""
    steps: RecordedSteps | None
    """The steps from which learners with a replay learn, too; None: there is none of these."""
    note: str
    """A sentence about each learner."""
    cuts: Cuts | None
    """The calls that were found in the data; None: they were not cut."""


def begin(declared: Any, content: Manifest, roles: Mapping[str, Role], data: Any) -> Beginning:
    """Return what learners begin with.

    Args:
        declared: a hierarchy, or a plain agent.
        content: the manifest of the new run.
        roles: of its learners, by path.
        data: a ``Dataset``, or of a hierarchy the ``Segments`` that were cut out of one.

    Raises:
        DeclarationError: it is neither, or has other spaces; or no learner learns from it.
    """
    flat = content.hierarchy is None
    if not isinstance(data, Dataset if flat else Dataset | Segments):
        kinds = "a Dataset" if flat else "a Dataset, or what hierarchy.segment() returned"
        raise DeclarationError(f"data is {short(data)}; it must be {kinds}")
    episodes = data.data if isinstance(data, Segments) else data
    if isinstance(data, Segments):
        _check_skills(declared, data)
    episodes.check_env(declared.spec)
    settings = _first_settings(content)
    readers = [name for name, config in settings.items() if _reads(config, roles[name])]
    recorded = episodes.recorded() if readers else None
    found: Dataset | Segments = data
    if not flat and isinstance(data, Dataset) and len(readers) < len(settings):
        found = segment(declared, data)
    learnt: dict[str, Learnt] = {}
    notes = []
    for name, config in settings.items():
        if recorded is not None and name in readers:
            notes.append(f"{name} learns from {_readable(config, roles[name], recorded, episodes)}")
            continue
        why = _why_not(config, roles[name])
        rows = None if why else _rows(name, found, roles[name])
        if not why and (rows is None or len(rows[0]) < FEWEST):
            count = 0 if rows is None else len(rows[0])
            why = f"{count} rows of it are in the data, fewer than {FEWEST}"
        if why:
            notes.append(f"{name} is not cloned: {why}")
            continue
        assert rows is not None
        seeds = Seeds(content.seed) / name / "clone"
        obs, action, group, mask = rows
        made: Clone = clone(config, obs, action, group, roles[name].spaces, seeds, mask)
        sha256 = made.policy.source()["sha256"]
        chooses = options_of(content, name)
        of = made.policy, sha256, made.rows, episodes.name, None, chooses
        learnt[name] = Learnt(*of, critic=False)
        notes.append(f"{name} is cloned: {made}")
    if not learnt and recorded is None:
        raise DeclarationError(f"no learner begins with {episodes.name}: {'; '.join(notes)}")
    cuts = found.cuts() if isinstance(found, Segments) else None
    return Beginning(learnt, recorded, "; ".join(notes), cuts)


def _check_skills(declared: Any, found: Segments) -> None:
    """Raise a DeclarationError where calls were found for the skills of another hierarchy."""
    level = roles_of(declared).levels[""]
    skills, lengths = level.names, tuple(level.lengths)
    log = found.log
    if (tuple(log.skills), tuple(log.lengths)) != (skills, lengths):
        raise DeclarationError(
            f"data are calls of {', '.join(log.skills)}, that another hierarchy found: this one "
            f"has {', '.join(skills)}"
            + f" and call lengths {lengths}" * (tuple(log.skills) == skills)
            + ". Let it find its own, hierarchy.segment(found.data)"
        )


def _reads(config: Any, role: Role) -> bool:
    """Return whether a learner has recorded steps in its replay."""
    return bool(getattr(config, "shared_replay", 0.0)) and role.kind in ("agent", "skill")


def _readable(config: Any, role: Role, steps: RecordedSteps, data: Dataset) -> str:
    """Return how many recorded steps a learner can learn from, in words.

    Raises:
        DeclarationError: it cannot judge them; or they lack what it reads.
    """
    judge = judge_of(config, role)
    assert judge is not None
    needed = [key.removeprefix(INFO) for key in judge.examples if key.startswith(INFO)]
    if lacks := [key for key in needed if key not in steps.info]:
        has = ", ".join(steps.info) or "none"
        raise DeclarationError(
            f"{judge.who} reads info[{lacks[0]!r}] in its reward or termination, but {data.name} "
            f"has the keys {has} of info"
        )
    if MASK not in steps.info and _masks(role):
        raise DeclarationError(
            f"{judge.who} is in an environment with action masks, but {data.name} has no "
            f"info[{MASK!r}]: values would be learnt of actions that were not allowed"
        )
    algorithm: Any = make_algorithm(config, *role.spaces)
    store = store_of(algorithm, 1, judge=judge, capacity=steps.room(1))
    assert isinstance(store, JudgedStore)
    rng = (Seeds(0) / "data").numpy()
    rows = store.add_recorded(steps.rows(1, store.raw), rng)
    count = int(rows["valid"].sum())
    if not count:
        raise DeclarationError(
            f"{judge.who} could have made no step of {data.name}: its part of the action (acts) "
            "leaves the rest as it is, and there the rest always differs"
        )
    if role.kind == "agent":
        _compare_rewards(judge.who, rows["reward"].ravel(), steps.reward, data.name)
    if is_offline(config):
        return f"{count:,} steps of {data.name} first, by gradient steps"
    return f"{count:,} steps of {data.name}"


def _compare_rewards(who: str, now: Array, given: Array, name: str) -> None:
    """Raise a DeclarationError where rewards that are computed again differ from the data's."""
    scale = float(np.abs(given).max(initial=0.01))
    differ = ~np.isclose(now, given, rtol=1e-4, atol=1e-4 * scale)
    if differ.mean() > DIFFERENT:
        at = int(differ.argmax())
        raise DeclarationError(
            f"{who} computes rewards again (hindsight), but in {differ.mean():.0%} of the steps of "
            f"{name} they differ from those that were recorded (in step {at} {now[at]:g}, recorded "
            f"{given[at]:g}): the data have another reward, or another goal"
        )


def _masks(role: Role) -> bool:
    """Return whether an environment says which actions are allowed."""
    engine = make_engine(role.spec, 1)
    try:
        engine.reset(0)
        return engine.mask() is not None
    finally:
        engine.close()


def _first_settings(content: Manifest) -> dict[str, Any]:
    """Return the settings by which each learner learns first, by its name."""
    found: dict[str, Any] = {}
    for stage in content.stages:
        for name in stage.learns:
            given = stage.algorithms.get(name, stage.algorithm)
            found.setdefault(name, config_from_json(given))
    return found


def _why_not(config: Any, role: Role) -> str:
    """Return why a learner is not cloned; empty: it is."""
    if role.kind == "critic":
        return "it is a critic"
    if hasattr(config, "shared_replay") and role.kind != "selector":
        return f"{type(config).__name__} learns from data by shared_replay, which is 0"
    if not isinstance(config, PPO):
        return f"{type(config).__name__} has no network whose actions can be cloned"
    if config.squash_actions and isinstance(role.action_space, Dict | Tuple):
        return "squash_actions of actions with several parts"
    if make_algorithm(config, *role.spaces).memory_size:
        return "its network has a memory"
    if role.skill is not None and isinstance(role.skill.policy, Learnable):
        return "it learns on from its own policy"
    if "/" in role.path:
        return "it is in a hierarchy that is a skill"
    if role.skill is not None and role.part is not None and role.part.base is not None:
        return "it corrects another policy"
    if role.kind == "selector" and role.chosen_goals:
        return "it chooses goals, too"
    return ""


Rows = tuple[Array, Array, Array, Array | None]
"""Observations, actions, groups and masks of the rows of a learner."""


def _rows(name: str, found: Any, role: Role) -> Rows | None:
    """Return the rows of a learner in data; None: there are none."""
    if name == AGENT:
        codec = action_codec(found.action_space)
        episode = np.repeat(np.arange(len(found)), found.lengths)
        return found.obs, codec.from_env(found.action), episode, None
    log = found.log
    if role.kind == "selector":
        return _decisions(found)
    if name not in log.skills:
        return None
    mine = np.flatnonzero(found.skill == log.skills.index(name))
    data = found.data
    goals = goals_of(role.skill)
    goal = None if goals is None else found.goals[name][found.call[mine]]
    obs = learner_obs(data.obs[mine], goal, goals, role.part)
    action, possible = own_actions(data.action[mine], role.part, action_codec(role.action_space))
    return obs[possible], action[possible], found.call[mine][possible], None


def _decisions(found: Segments) -> Rows:
    """Return the decisions of a selector: the skill of each call, where it starts."""
    log = found.log
    choice = log.skill
    if log.lengths:
        each = len(log.lengths)
        # The shortest length in which the call would have ended.
        length = np.minimum(np.searchsorted(log.lengths, log.tau), each - 1)
        choice = choice * each + length
    may = found.startable.repeat(max(1, len(log.lengths)), axis=1)
    return log.start, choice, log.episode, may
