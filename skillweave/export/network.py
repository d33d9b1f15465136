"""Networks of an export as policies: their entry in ``policy.json``, and how they act.

Stands alone because ``states`` writes such entries and ``read`` reads them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, TypedDict

import gymnasium as gym
import numpy as np

from skillweave.errors import PolicyError
from skillweave.export import graphs
from skillweave.messages import short
from skillweave.settings import Check
from skillweave.skills.mapping import Part, PolicyMapping, Source
from skillweave.skills.onnx_file import NUMBERS, OnnxPolicy
from skillweave.skills.plan import leaves_of
from skillweave.spaces import ChoiceSpace
from skillweave.types import Array, Memory

FileName = Annotated[
    str,
    Check(
        "the name of an ONNX file in the folder",
        lambda x: x.endswith(".onnx") and not set(x) & set("/\\\0") and not x.startswith("."),
    ),
]
Width = Annotated[int, Check("at least 0 and at most 100,000,000", lambda x: 0 <= x <= 10**8)]


class NetworkEntry(TypedDict):
    """A network that was trained by this library; kind "Network"."""

    file: FileName
    choices: Width
    """The width of its input ``mask``; 0: it has none."""
    memory: dict[str, Width]
    """The widths of its recurrent state, by the name of its input."""
    noise: list[tuple[Literal["gumbel", "standard_normal", "random", "logistic"], Width]]
    """The distribution and width of each of its inputs ``noise.0``, ``noise.1``, …"""


def leaf_inputs(space: gym.Space[Any]) -> dict[str, tuple[Source, ...]]:
    """Return the inputs of a file that takes each leaf of an observation by itself."""
    leaves = leaves_of(space)
    names = [f"obs.{leaf.name}" if leaf.fields else "obs" for leaf in leaves]
    parts = [(Part(leaf.name, one_hot=False),) for leaf in leaves]
    return dict(zip(names, parts, strict=True))


class ExportedNetwork(OnnxPolicy):
    """A network of an export: it returns actions, and takes a mask and noise."""

    logits = False

    def __init__(
        self,
        content: bytes,
        file: Path,
        entry: NetworkEntry,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        output: str = "action",
    ) -> None:
        self.entry = entry
        self.extra = tuple(
            [f"noise.{i}" for i in range(len(entry["noise"]))] + ["mask"] * bool(entry["choices"])
        )
        mapping = PolicyMapping(
            sees=leaf_inputs(observation_space),
            state=tuple((name, f"{name}.after") for name in entry["memory"]),
        )
        super().__init__(content, file, output, observation_space, action_space, mapping)
        self._check_inputs()

    def _check_inputs(self) -> None:
        """Raise a PolicyError where the file has other inputs than its entry and spaces say."""
        entry, width = self.entry, graphs.mask_width(self.action_space)
        if entry["choices"] != width:
            raise PolicyError(
                f"choices is {entry['choices']}; for {short(self.action_space)} it must be {width}"
            )
        leaves = graphs.leaves_of(self.observation_space)
        given = {leaf.name: f"{leaf.dtype} {leaf.shape}" for leaf in leaves}
        given |= {"mask": f"bool ({width},)"} if width else {}
        given |= {name: f"float32 ({n},)" for name, n in entry["memory"].items()}
        given |= {f"noise.{i}": f"float32 ({n},)" for i, (_, n) in enumerate(entry["noise"])}
        taken = {
            name: f"{np.dtype(NUMBERS.get(x.type, bool))} {tuple(x.shape[1:])}"
            for name, x in self._inputs.items()
        }
        for name in given | taken:
            if given.get(name) != taken.get(name):
                raise PolicyError(
                    f"{self.file} takes {taken.get(name, 'nothing')} as {short(name)}, but "
                    f"is given {given.get(name, 'nothing')}"
                )

    def fit_mapping(self) -> None:
        """Fit the mapping to the spaces; choices with goals are rows of numbers in the file."""
        space = self.action_space
        if isinstance(space, ChoiceSpace):
            self.action_space = gym.spaces.Box(-np.inf, np.inf, (space.row_size,), np.float64)
        try:
            super().fit_mapping()
        finally:
            self.action_space = space

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
        goal: Array | None = None,
    ) -> tuple[Array, Memory]:
        """Return actions, or choices; see ``MappedPolicy``."""
        how: Any = {"deterministic": deterministic, "rng": rng, "goal": goal}
        action, memory = super().act(memory, obs, mask, **how)
        space = self.action_space
        return space.of_rows(action) if isinstance(space, ChoiceSpace) else action, memory

    def more_inputs(
        self, n: int, mask: Array | None, rng: np.random.Generator | None
    ) -> dict[str, Array]:
        """Return the mask, and noise from ``rng``."""
        given: dict[str, Array] = {}
        if choices := self.entry["choices"]:
            given["mask"] = np.ones((n, choices), bool) if mask is None else mask
        rng = rng or np.random.default_rng()
        for i, (kind, width) in enumerate(self.entry["noise"]):
            given[f"noise.{i}"] = getattr(rng, kind)(size=(n, width)).astype(np.float32)
        return given

    def worth(self, obs: Array) -> Array:
        """Return the values (n, S + 1) of a critic for observations."""
        return self.act(self.start(len(obs)), obs)[0]
