"""The ONNX file from which a skill learnt on, with what it has learnt: ``Run.save_onnx``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from skillweave._internal.messages import short, shown_path, suggest
from skillweave._internal.notices import notice
from skillweave._internal.policy_protocol import Policy
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.errors import DeclarationError, RunError
from skillweave.hierarchy.assembly import own_parts_of, parts_of
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.hierarchy.roles import Roles
from skillweave.policies.core import Array
from skillweave.runs.directory import RunDirectory
from skillweave.runs.initial_policies import file_at_start
from skillweave.skills.learnable import Layers
from skillweave.skills.onnx_layers import read_network, rewritten


def learnt_file(path: Path, roles: Roles, policy: Policy, skill: Any) -> bytes:
    """Return the ONNX file from which a skill learnt on, with the weights that it has now.

    Args:
        path: of the run.
        roles: of its hierarchy.
        policy: of the hierarchy.
        skill: its path.

    Raises:
        DeclarationError: no such skill, or one that did not learn on from a file.
        RunError: this is no run's directory, or its copy of the file is missing or damaged.
    """
    files = roles.files()
    if not isinstance(skill, str) or skill not in roles.skills:
        raise DeclarationError(
            f"save_onnx(): skill is {short(skill)}; it must be the name of a skill"
            f"{suggest(skill, roles.skills)}"
        )
    if skill not in files:
        has = f"; that is true of {', '.join(files)}" if files else ""
        raise DeclarationError(
            f"save_onnx() writes a skill that learns on from from_onnx(..., learn=True), and "
            f"{skill!r} does not{has}: write the whole policy, run.export(folder)"
        )
    if not path.is_dir():
        raise RunError(
            f"save_onnx(): {shown_path(path)} is a file of weights, which does not hold the ONNX "
            "file: load the run's directory"
        )
    file = files[skill]
    assert isinstance(policy, HierarchyPolicy)
    learnt = parts_of(roles, policy)[skill]
    assert isinstance(learnt, AgentPolicy)
    run = RunDirectory.open(path)
    for stage in run.manifest.stages:
        if skill in stage.learns and stage.kept is not None and stage.kept.is_worse:
            notice(f"save_onnx(): {skill!r} is clearly worse than its file: {stage.kept}")
    data = file_at_start(run, skill)
    before = read_network(data, file.output, file.name).layers
    layers = _layers(learnt, before)
    part = own_parts_of(roles, policy)[skill]
    if part.goal_columns is not None:
        layers = part.goal_columns.unfold(layers, before)
    return rewritten(data, file.output, layers, file.name)


def _layers(learnt: AgentPolicy, like: Layers) -> Layers:
    """Return the layers of a trained actor."""

    def arrays(kind: str) -> tuple[Array, ...]:
        names = (f"actor.{i}.{kind}" for i in range(len(like.weights)))
        return tuple(np.asarray(learnt.weights[name].numpy(), np.float64) for name in names)

    biases = tuple(bias.reshape(-1) for bias in arrays("bias"))
    return replace(like, weights=arrays("weight"), biases=biases)
