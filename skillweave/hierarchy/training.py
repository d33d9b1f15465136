"""Training a hierarchy: every skill, then the selector; or the flat baseline."""

from __future__ import annotations

from typing import Any

from skillweave.envs.foreign import FromVectorEnv
from skillweave.envs.make import make_engine
from skillweave.envs.skill_env import SkillEnv
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.options import OptionsEnv
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.hierarchy.weights import check_parts
from skillweave.ops.threads import torch_threads
from skillweave.runs.directory import RunDirectory
from skillweave.seeding import Seeds
from skillweave.skills import Skill, ready_policy
from skillweave.skills.foreign_policy import source_of
from skillweave.training.phase import Listener, Phase, Trainer, train_phase
from skillweave.training.probe import MakeEnv
from skillweave.types import Policy, VecEnv


def manifest(declaration: Declaration, *, seed: int, flat: bool) -> dict[str, Any]:
    """What a new run's ``run.json`` says."""
    phases = [flat_phase(declaration)] if flat else phases_of(declaration)
    return {
        "kind": "flat" if flat else "hierarchy",
        "env": declaration.spec.name,
        "env_kwargs": declaration.spec.kwargs,
        "seed": seed,
        "cut_every": declaration.cut_every,
        "eval_every": declaration.eval_every,
        "eval_episodes": declaration.eval_episodes,
        "skills": [_skill_entry(s) for s in declaration.skills],
        "call_steps": declaration.call_steps,
        "greedy_skills": declaration.greedy_skills,
        "reflexes_in_training": declaration.reflexes_in_training,
        "resume_needs_recipe": not declaration.trains_from_data,
        "reflexes": [r.name for r in declaration.reflexes],
        "needs_recipe": not (declaration.spec.is_data if flat else declaration.is_data),
        "phases": [p.entry() for p in phases],
    }


def phases_of(declaration: Declaration) -> list[Phase]:
    """The skills that are to be trained, then the selector (which cannot train before them)."""
    phases = [
        Phase(
            s.name,
            s.algorithm or declaration.algorithm,
            declaration.budget(s),
            _skill_env(declaration, s),
        )
        for s in declaration.skills
        if s.policy is None
    ]

    def too_early(num_envs: int, gamma: Any) -> VecEnv:
        raise AssertionError("the selector's environment needs the skills' policies")

    return [
        *phases,
        Phase("selector", declaration.selector, declaration.selector_steps, too_early),
    ]


def flat_phase(declaration: Declaration) -> Phase:
    """One agent on the task itself: the baseline, or all that is asked for."""
    config = declaration.flat or declaration.algorithm
    budget = declaration.flat_steps or declaration.total_steps
    return Phase("flat", config, budget, _skill_env(declaration, None))


@torch_threads(1)  # a loop sets its own; all else must not depend on how many there are
def train(
    declaration: Declaration,
    run: RunDirectory,
    listeners: tuple[Listener, ...] = (),
    train_phase: Trainer = train_phase,
) -> Policy:
    """Train, or finish training, what the run says; returns the policy."""
    seeds = Seeds(int(run.manifest["seed"]))
    if run.manifest["kind"] == "flat":
        return train_phase(flat_phase(declaration), run, seeds / "flat", listeners)
    policies = _ready(declaration, run)
    for name, ready in policies.items():
        run.keep_policy(name, ready)
    *skill_phases, selector = phases_of(declaration)
    for phase in skill_phases:
        policies[phase.name] = train_phase(phase, run, seeds / phase.name, listeners)
    skills = declaration.skill_set([policies[s.name] for s in declaration.skills])

    def make_env(num_envs: int, gamma: Any) -> VecEnv:
        engine = make_engine(declaration.spec, num_envs)
        return FromVectorEnv(OptionsEnv(engine, skills, gamma))

    phase = Phase("selector", selector.config, selector.budget, make_env)
    policy = train_phase(phase, run, seeds / "selector", listeners)
    return HierarchyPolicy(policy, skills)


def load(declaration: Declaration, run: RunDirectory) -> Policy:
    """The policy of a finished run."""
    if run.manifest["kind"] == "flat":
        return run.load_policy("flat")
    ready = _ready(declaration, run)
    names = [s.name for s in declaration.skills]
    policies = [ready[n] if n in ready else run.load_policy(n) for n in names]
    selector = run.load_policy("selector")
    check_parts(declaration, policies, selector, str(run.path))
    return HierarchyPolicy(selector, declaration.skill_set(policies))


def _ready(declaration: Declaration, run: RunDirectory) -> dict[str, Policy]:
    """The ready policies as they were when the run began."""
    ready = declaration.ready_policies()
    return {name: run.ready_policy(name, policy) for name, policy in ready.items()}


def _skill_env(declaration: Declaration, skill: Skill | None) -> MakeEnv:
    # The flat baseline is the plain task: no reflexes either.
    with_reflexes = declaration.reflexes_in_training and skill is not None
    reflexes = tuple(declaration.reflexes) if with_reflexes else ()

    def make_env(num_envs: int, gamma: Any) -> VecEnv:
        return SkillEnv(make_engine(declaration.spec, num_envs), skill, reflexes)

    return make_env


def _skill_entry(skill: Skill) -> dict[str, Any]:
    policy = ready_policy(skill)
    entry = {"name": skill.name, "max_steps": skill.max_steps, "ready": policy is not None}
    return entry if policy is None else entry | {"policy": source_of(policy)}
