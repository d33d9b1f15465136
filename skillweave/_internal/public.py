"""Public names: where users import each one, and which module has it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib import import_module
from typing import Any

PUBLIC = {
    "skillweave": {
        "algorithms.config": "CQL DQN IQL PPO SAC TD3",
        "api": "Agent Hierarchy Run train_agent",
        "api.loading": "from_hub load",
        "api.player": "Player",
        "api.policies": "load_policy save_policy",
        "skills.lengths": "Lengths",
        "data.dataset": "Dataset",
        "data.recording": "record",
        "envs.make": "EnvSpec",
        "errors": "SkillweaveError",
        "hierarchy.settings": "Apart Guide Selection",
        "networks.config": "Network",
        "policies.core": "Step",
        "robots.deploy_yaml": "from_deploy",
        "robots.inputs": "inputs",
        "robots.measuring": "handovers",
        "robots.onnx_metadata": "from_metadata reference_motion",
        "skills": "Reflex Residual Skill from_function from_onnx from_sb3 from_torch tree",
        "skills.automaton": "Automaton",
        "skills.mapping": "Acts Elapsed Goal LastAction Part Table",
        "training.defaults": "TrainDefaults",
        "training.evaluation": "evaluate",
        "training.stage": "Together",
    },
    "skillweave.algorithms": {
        "algorithms.base": "ActingParams AgentState Algorithm",
        "algorithms.config": "Hindsight OnPolicy SelfImitationPPO",
        "algorithms.parameters": "ParameterGroup",
        "algorithms.schedules": "Linear",
        "algorithms.registry": "register_algorithm",
        "algorithms.batches": "Report Rollout Sample",
        "networks.config": "CNN RNN",
        "networks.encoders": "Encoder register_encoder",
        "networks.heads": "ActionHead",
        "networks.net": "Net",
        "networks.stacked": "Layout",
        "ops.distributions": "mask_logits",
        "ops.moments": "masked_mean normalize",
        "ops.optim": "adam_ clip_grad_norm_",
        "ops.returns": "gae",
    },
    "skillweave.calls": {
        "calls.handover": "Blame CallEnds Chain Handover",
        "calls.log": "CallLog join",
        "calls.predicates": "Predicate held successes",
        "calls.record": "record_calls",
    },
    "skillweave.envs": {
        "api.make_options": "make_options_env",
        "envs.pool": "PoolWrapper envpool one_of",
        "hierarchy.options_env": "OptionsEnv",
    },
    "skillweave.errors": {
        "errors": "EnvError Interrupted MissingExtra TrainingError",
        "policies.acting_errors": "DeclarationError PolicyError RunError SkillError",
    },
    "skillweave.evolution": {
        "evolution.config": "Evolution Mutations Range Tournament Truncation",
        "evolution.selection": "Heir ParentSelection",
    },
    "skillweave.extensions": {"extensions": "fetch"},
    "skillweave.html_report": {"html_report.sections": "Reported Section"},
    "skillweave.planning": {
        "planning.explorer": "Explorer",
        "planning.forecast": "Forecast",
        "planning.goal": "GoalTask reached",
        "planning.machine": "RewardMachine",
        "planning.mission": "Mission as_task either in_any_order",
        "planning.planned_run": "PlannedRun",
        "planning.planner": "Planner",
    },
    "skillweave.reporting": {"reporting.curves_figure": "plot_curves"},
    "skillweave.data": {"data.segmenting": "Segments"},
    "skillweave.robots": {
        "robots.inputs": "InputPart InputSheet OutputLimits",
        "robots.measured": "Between ChainChance Entry HandoverTable Pair",
        "robots.measuring": "MeasuredHandovers",
        "robots.read_mapping": "ReadMapping",
        "robots.remedies": "Effect Remedies Tried",
    },
    "skillweave.types": {
        "export.write": "Export",
        "hierarchy.policy": "HierarchyPolicy",
        "policies.core": "Array LastCall",
        "_internal.policy_protocol": "Policy",
        "_internal.seeding": "Seeds",
        "training.callback": "TrainEvent",
        "training.evaluation": "Evaluation",
    },
    "skillweave.workers": {"workers.cluster": "Ray"},
}
"""By module that users import from: the names of each module of the library."""

HOMES = {
    module: {name: home for home, names in homes.items() for name in names.split()}
    for module, homes in PUBLIC.items()
}
"""Modules that define the public names, by public module and name."""


ALSO = {"skillweave.planning": "skillweave.calls"}
"""Modules in which the names of another one are found, too: tasks are made of predicates."""


def lazy(module: str) -> tuple[list[str], Callable[[str], Any], Callable[[], Iterable[str]]]:
    """Return ``__all__``, ``__getattr__`` and ``__dir__`` of a module that users import from.

    Names are imported when first used: torch takes two seconds, which ``--help`` must not pay.
    """
    homes = HOMES.get(ALSO.get(module, ""), {}) | HOMES[module]

    def get(name: str) -> Any:
        """Import a public name of the module when it is first used."""
        if name in homes:
            from skillweave.extensions import resolve

            return resolve(f"skillweave.{homes[name]}:{name}", name)
        if f"{module}.{name}" in HOMES:  # sw.algorithms needs no import of its own
            return import_module(f"{module}.{name}")
        from difflib import get_close_matches

        hints = [f": it is in {other}" for other, names in HOMES.items() if name in names]
        hints += [f": is {near!r} meant?" for near in get_close_matches(name, homes, n=1)]
        raise AttributeError(f"module {module!r} has no attribute {name!r}{''.join(hints[:1])}")

    return sorted(homes), get, homes.keys
