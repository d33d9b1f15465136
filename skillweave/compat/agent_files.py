"""One agent as a file: a policy, and all that further learning needs."""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.base import Algorithm
from skillweave.algorithms.policy import AgentHeader, AgentPolicy, state_from
from skillweave.errors import RunError
from skillweave.policies.files import check_file
from skillweave.runs.files import read_tensors, record_in, write_tensors


def save_agent(path: str | Path, algorithm: Algorithm, state: Any, about: dict[str, Any]) -> None:
    """Write the one member of a state; ``about`` is plain JSON."""
    tensors, header = AgentPolicy.of(algorithm, state).to_file()
    tensors = tensors | {f"state.{k}": v for k, v in vars(state).items()}
    write_tensors(Path(path), tensors, replace(header, about=about))


def load_agent(path: str | Path, seeds: Seeds) -> tuple[Algorithm, Any, dict[str, Any]]:
    """Return the algorithm, its state, and the ``about`` that was saved with it.

    A file that holds a policy alone gives the weights; everything else starts fresh.

    Raises:
        RunError: the file is missing, damaged, a pickle, or holds no agent.
    """
    check_file(Path(path))
    if zipfile.is_zipfile(path):
        raise RunError(
            f"{path} is a pickle of torch.save's, and a pickle can run code. If it is a checkpoint "
            "of AgileRL's and you trust where it comes from, convert it: skillweave "
            f"import-agilerl {path} --trust"
        )
    tensors, header = read_tensors(Path(path))
    of: AgentHeader = record_in(AgentHeader, header, path)
    algorithm = AgentPolicy.from_file(tensors, of, str(path)).algorithm
    state = algorithm.init([seeds])
    algorithm.set_weights(state, tensors)
    saved = {k[len("state.") :]: v for k, v in tensors.items() if k.startswith("state.")}
    if saved:
        state = state_from(vars(state) | saved, state, str(path), algorithm.parameter_groups())
    return algorithm, state, of.about
