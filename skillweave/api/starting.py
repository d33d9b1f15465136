"""Starts from other runs: find the policies with which learners of a new run start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Protocol

import torch

from skillweave._internal.messages import as_path, short, suggest
from skillweave._internal.notices import notice
from skillweave._internal.paths import AGENT, decides
from skillweave._internal.policy_protocol import is_policy
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy, make_algorithm
from skillweave.algorithms.base import Algorithm
from skillweave.algorithms.config import config_from_json
from skillweave.errors import DeclarationError, PolicyError, RunError
from skillweave.policies.untrusted import shown
from skillweave.runs.initial_policies import (
    Chooses,
    Learnt,
    learners_of_run,
    options_of,
    record_initial_policies,
)
from skillweave.runs.manifest import Manifest, StageEntry
from skillweave.runs.user_code import changes
from skillweave.skills.goal_spaces import goal_part, other_goals
from skillweave.skills.learnable import Learnable
from skillweave.spaces import same_space
from skillweave.training.role import Role


class InDirectory(Protocol):
    """An object with the path of a run's directory, such as ``Run``."""

    path: Path
    """Its directory."""


Origin = str | Path | InDirectory | Learnable | Learnt
"""The source of a learner's first weights: a run, its directory, or a policy made elsewhere
(``from_sb3(..., learn=True)``)."""
StartFrom = Origin | Mapping[str, Origin] | None
"""The argument ``start_from``: one origin for all learners of the same names, or one by learner."""


def starts(
    content: Manifest,
    start_from: StartFrom,
    roles: Mapping[str, Role],
) -> tuple[dict[str, Learnt], str]:
    """Return the policies that learners start from, by name, and a sentence about them.

    The manifest then holds the start of each learner.

    Args:
        content: the manifest of the new run.
        roles: of its learners, by path.
    """
    if isinstance(start_from, Learnable):
        start_from = {AGENT: start_from}
    skills = {path: role.skill for path, role in roles.items() if role.skill is not None}
    declared = {path: s.policy for path, s in skills.items() if isinstance(s.policy, Learnable)}
    if start_from is None and not declared:
        return {}, ""
    if isinstance(start_from, Mapping):
        if not start_from:
            raise DeclarationError('start_from is {}; name the run of each learner: {"left": run}')
        learnt = _learnt_by_name(content, {**declared, **start_from}, roles)
    else:
        learnt = _learnt_by_name(content, declared, roles)
        if start_from is not None:
            learnt |= learners_of_run(_place(start_from, "start_from"))
    # A dict rather than a set: the runs in the order in which they were given.
    where = ", ".join(dict.fromkeys(one.where for one in learnt.values()))
    started = record_initial_policies(content.stages, learnt, where)
    for origin in dict.fromkeys(learnt[name].where for name in sorted(started)):
        names = [name for name in started if learnt[name].where == origin]
        ends = tuple(f"skill {name!r}" for name in names)
        now = {k: v for k, v in content.code.items() if " skill " not in k or k.endswith(ends)}
        if says := changes(learnt[names[0]].code, now):
            notice(f"start from {origin}: {says} since it was trained")
    for stage in content.stages:
        for name in stage.starts:
            role = roles[name]
            algorithm = make_algorithm(
                _config_in(stage, name), role.observation_space, role.action_space
            )
            _check_start(role, algorithm, content, learnt[name])
    return learnt, f"start from {where}: {', '.join(sorted(started))}"


def _learnt_elsewhere(name: str, origin: Learnable, role: Role, content: Manifest) -> Learnt:
    """Return a policy made elsewhere as one that was learnt here.

    What it does not have (of PyTorch modules the critic, for example) is drawn by the run's seed.

    Raises:
        DeclarationError: the algorithm has other networks; the message has the right ones.
        PolicyError: it was made for other spaces.
    """
    if decides(name):
        raise DeclarationError(
            f"start_from: {origin.name} acts in an environment, and {name!r} does not learn that"
        )
    if origin.file is not None and (role.skill is None or role.skill.policy is not origin):
        raise DeclarationError(
            f"start_from: {origin.name} learns on with sees and acts of its own, which only a "
            "skill has: write it as the skill's policy, policy = sw.from_onnx(..., learn=True)"
        )
    goals = None if role.skill is None else role.skill.goal_space
    origin.check(role.observation_space, role.action_space, goals, f"start_from: {name!r}")
    first = next(stage for stage in content.stages if name in stage.learns)
    config = _config_in(first, name)
    fits = origin.learning_on(config, repr(name))
    changed = [
        f"{f.name}={getattr(fits, f.name)!r}"
        for f in fields(fits)
        if getattr(fits, f.name) != getattr(config, f.name)
    ]
    if changed:
        raise DeclarationError(
            f"start_from: {name!r} cannot start with {origin.name}, whose networks are others: "
            f"write {origin.kind}({', '.join(changed)}), with the settings that you have"
        )
    algorithm = make_algorithm(config, role.observation_space, role.action_space)
    fresh = algorithm.weights(algorithm.init([Seeds(content.seed) / name / "start"]))
    goal = None if role.part is None else role.part.goal_columns
    given = origin.weights(role.action_space, goal)
    weights = {k: torch.from_numpy(v) for k, v in given.items()}
    wrong = [k for k, v in weights.items() if k not in fresh or fresh[k].shape != v.shape]
    if wrong:
        raise PolicyError(
            f"{origin.name} does not fit {name!r}: its networks ({origin.sizes}) take or return "
            f"another number of values than {short(role.observation_space, 200)} and "
            f"{short(role.action_space, 200)} have"
        )
    policy = AgentPolicy(algorithm, fresh | weights)
    of = policy, origin.sha256(), origin.steps, origin.name, None, ((), ())
    return Learnt(*of, critic="critic" in origin.networks)


def _config_in(stage: StageEntry, name: str) -> Any:
    """Return the settings by which a learner learns in a stage of a manifest."""
    return config_from_json(stage.algorithms.get(name, stage.algorithm))


def _place(run: Any, argument: str) -> Path:
    """Return the directory of the run in the argument ``start_from``.

    Raises:
        DeclarationError: it is a policy, or a file with one; the message names its use.
    """
    if (use := _use_of(run)) is not None:
        what, way = use
        raise DeclarationError(
            f"{argument} is {what}, and a training starts only from what a run of Skillweave has "
            f"learnt: its directory; {way}"
        )
    return as_path(getattr(run, "path", run), argument)


def _use_of(value: Any) -> tuple[str, str] | None:
    """Return words on a policy from elsewhere and on its use, for errors; None: it is none."""

    def as_skill(policy: str) -> str:
        return (
            "to let it act untrained, make it a skill of a hierarchy: class Ready(sw.Skill): "
            f"policy = {policy}"
        )

    if isinstance(value, str | Path) and "\0" not in str(value):
        path = as_path(value, "start_from")
        if path.is_dir():
            return None
        # Stable-Baselines3 adds the ending where it saves and loads.
        bare = not path.exists() and path.with_name(f"{path.name}.zip").exists()
        if path.suffix == ".zip" or bare:
            zipped = str(path) if path.suffix == ".zip" else f"{path}.zip"
            call = f'sw.from_sb3({zipped!r}, "ppo", trust=True'
            further = f"; to train it further, give {call}, learn=True) in place of the file"
            return f"the file {zipped}", as_skill(f"{call})") + further
        if path.suffix == ".onnx":
            return f"the file {path}", as_skill(f"sw.from_onnx({str(path)!r})")
        if path.suffix in (".pt", ".pth"):
            return f"the file {path}", as_skill("the torch module with these weights")
        if path.suffix == ".safetensors":
            way = "start from the run that it was written from"
            return f"the weights file {path}", way
        return None
    if hasattr(value, "predict") and hasattr(value, "policy"):  # a model of Stable-Baselines3
        further = "; to train it further, give sw.from_sb3(model, learn=True) in its place"
        return f"a {type(value).__name__}", as_skill("sw.from_sb3(model)") + further
    if hasattr(value, "state_dict") and not isinstance(value, type):
        learns = (
            "; to train it further, give sw.from_torch(module, learn=True) in its place, or let a "
            "function of the observation space return a copy of its layers before the last: "
            "Network(encoder=function)"
        )
        return f"a {type(value).__name__}, a torch module", as_skill("module") + learns
    if callable(value) or is_policy(value):
        return f"{short(value)}, a policy", as_skill("this one")
    return None


def _learnt_by_name(
    content: Manifest, start_from: Mapping[str, Origin], roles: Mapping[str, Role]
) -> dict[str, Learnt]:
    """Return the policy that each named learner starts from.

    Raises:
        DeclarationError: a name does not learn here.
        RunError: a name has not learnt in its run.
    """
    here = sorted({name for entry in content.stages for name in entry.learns})
    learnt: dict[str, Learnt] = {}
    known: dict[Path, dict[str, Learnt]] = {}
    for name, run in start_from.items():
        if name not in here:
            raise DeclarationError(
                f"start_from names {short(name)}, which does not learn here{suggest(name, here)}"
            )
        if isinstance(run, Learnt):
            learnt[name] = run
            continue
        if isinstance(run, Learnable):
            learnt[name] = _learnt_elsewhere(name, run, roles[name], content)
            continue
        place = _place(run, f"start_from[{name!r}]")
        if place not in known:
            known[place] = learners_of_run(place)
        there = known[place]
        # A plain agent's run has one learner, whatever it is to be here.
        policy = there.get(name) or (there.get(AGENT) if set(there) == {AGENT} else None)
        if policy is None:
            raise RunError(
                f"start_from[{name!r}]: {name!r} has not learnt in {place}; there learnt "
                f"{', '.join(there) or 'no one: no stage was finished'}"
            )
        learnt[name] = policy
    return learnt


def _check_start(role: Role, algorithm: Algorithm, content: Manifest, learnt: Learnt) -> None:
    """Raise a RunError where a learner cannot start from its policy in another run."""
    before = learnt.policy.algorithm
    chooses = options_of(content, role.path)
    goal_space = None if role.skill is None else role.skill.goal_space
    kinds = [type(a.config).__name__ for a in (before, algorithm)]
    there, here = before.weight_shapes(), algorithm.weight_shapes()
    what = ""
    if there.keys() != here.keys() and len(set(kinds)) > 1:
        what = f"it learnt by {kinds[0]} there, and is to learn by {kinds[1]} here"
    elif learnt.chooses != chooses:
        what = (
            f"there it chooses from {_choices(learnt.chooses)}, and here from {_choices(chooses)}"
        )
    elif not same_space(before.observation_space, algorithm.observation_space):
        what = "its observations are others here"
    elif goal_space is not None and (
        says := other_goals(goal_part(before.observation_space), goal_space)
    ):
        what = f"it {says}"
    elif not same_space(before.action_space, algorithm.action_space):
        what = "its actions are others here"
    elif _networks(before) != _networks(algorithm) or there != here:
        what = "it has other networks here (network, critic, normalize_obs, or kinds of cells)"
    cannot = f"start_from: {role.path!r} cannot start with what it learnt in {learnt.where}: "
    if what:
        raise RunError(cannot + what)
    entry = content.by_path.get(role.path)
    for field in ("sees", "acts", "residual", "learns_on"):
        then = getattr(learnt.entry or entry, field, None)
        now = getattr(entry, field, None)
        if entry is not None and then != now:
            raise RunError(
                f"{cannot}there its {field} was {shown(then)}, and here it is "
                f"{shown(now)}. Declare it as it was, or name the other learners alone, "
                f"start_from={{name: run}}, and {role.path!r} begins new"
            )


def _choices(chooses: Chooses) -> str:
    skills, lengths = chooses
    return ", ".join(skills) + (f" in calls of {lengths} steps" if lengths else "")


def _networks(algorithm: Algorithm) -> list[Any]:
    return [getattr(algorithm.config, k, None) for k in ("network", "critic")]
