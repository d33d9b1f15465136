"""What all agents share: a native one under AgileRL's names, and its history."""

from __future__ import annotations

import zipfile
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar, Self

import gymnasium as gym
import numpy as np
import torch

from skillweave.evolution.by_hand import ByHand
from skillweave.evolution.stacks import Member
from skillweave.networks.config import CNN, Network
from skillweave.runs.agilerl import ACTIVATIONS
from skillweave.types import SkillweaveError

MLP: dict[str, Any] = {"arch": "mlp", "hidden_size": [64, 64]}
_PAST = ("scores", "fitness", "steps", "mut", "index", "beta", "prior_eps")


class Setting:
    """An attribute that is a setting of the native agent; ``inverse``: one over it."""

    def __init__(self, field: str, inverse: bool = False) -> None:
        self._field, self._inverse = field, inverse

    def __get__(self, agent: Agent, owner: type) -> Any:
        value = getattr(agent.native.member.config, self._field)
        return round(1.0 / value) if self._inverse else value

    def __set__(self, agent: Agent, value: Any) -> None:
        agent.native.set(**{self._field: 1.0 / float(value) if self._inverse else plain(value)})


class Agent:
    """An agent as AgileRL has it; ``native`` is all that acts and learns."""

    algo: ClassVar[str]
    kind: ClassVar[type]
    getAction: Any
    batch_size, gamma = Setting("batch_size"), Setting("gamma")

    def _start(self, given: dict[str, Any], actions: gym.Space[Any], **own: Any) -> None:
        """Begin with fresh weights; ``given`` are the constructor's arguments."""
        for name, value in given.items():
            if (name == "accelerator" or "_network" in name) and value is not None:
                raise SkillweaveError(
                    f"{self.algo}({name}=...) is not supported; for networks beyond net_config "
                    "see register_encoder of the native API"
                )
        own["network"] = _network(given["net_config"], "Tanh" if self.algo == "PPO" else "ReLU")
        known = {f.name for f in fields(self.kind)}
        made = self.kind(**own | {k: plain(v) for k, v in given.items() if k in known})
        self._wrap(ByHand(Member(0, made, None), (_observations(given), actions), random_seed()))
        self.index, self.mut, self.device = given["index"], given["mut"], given["device"]

    def _wrap(self, native: ByHand) -> None:
        self.native, (seen, done) = native, native.spaces
        self.scores: list[float] = []
        self.fitness: list[float] = []
        self.index, self.mut, self.steps, self.device = 0, None, [0], "cpu"
        self.one_hot, self.discrete_actions = not seen.shape, not done.shape
        self.state_dim = seen.shape or (int(seen.n),)
        self.action_dim = int(done.shape[0] if done.shape else done.n)

    mut: str | None

    def test(
        self, env: Any, swap_channels: bool = False, max_steps: int = 500, loop: int = 3
    ) -> float:
        """Mean return of ``loop`` episodes in the first environment; kept in ``fitness``."""
        returns = np.zeros(loop)
        for i in range(loop):
            state = env.reset()[0]
            for _ in range(max_steps):
                action = self.getAction(np.moveaxis(state, -1, -3) if swap_channels else state)
                action = action[0] if isinstance(action, tuple) else action
                state, *step = env.step(action if hasattr(env, "num_envs") else action[0])
                reward, *ends = (np.ravel(x)[0] for x in step[:3])
                returns[i] += reward
                if any(ends):
                    break
        self.fitness.append(float(returns.mean()))
        return self.fitness[-1]

    def clone(self, index: int | None = None, wrap: bool = True) -> Self:
        """The same agent, but with chance of its own."""
        found = type(self).__new__(type(self))
        found._wrap(self.native.copy(random_seed()))
        found.__dict__.update(self._past(), device=self.device)
        found.index = self.index if index is None else index
        return found

    def _past(self) -> dict[str, Any]:
        return {k: np.array(getattr(self, k)).tolist() for k in _PAST if hasattr(self, k)}

    def saveCheckpoint(self, path: str | Path) -> None:
        """Write a native agent, as safetensors and JSON whatever the path, and its history."""
        self.native.save(path, {"algo": self.algo, **self._past()})

    def loadCheckpoint(self, path: str | Path) -> None:
        """Become the agent of a checkpoint, or of any file with a native agent of this kind.

        Raises:
            SkillweaveError: the file is missing, a pickle of AgileRL's, or another algorithm's.
        """
        if zipfile.is_zipfile(path):
            raise SkillweaveError(
                f"{path} is a pickle of AgileRL's, and a pickle can run code. If you trust where "
                f"it comes from, convert it: skillweave import-agilerl {path} --trust"
            )
        native, past = ByHand.load(path, random_seed())
        algo = past.pop("algo", self.algo)
        if not isinstance(native.member.config, self.kind) or algo != self.algo:
            kind = type(native.member.config).__name__
            raise SkillweaveError(f"{path} holds an agent of {kind} ({algo}), not of {self.algo}")
        self._wrap(native)
        self.__dict__.update(past)

    @classmethod
    def load(cls, path: str | Path, device: Any = "cpu", accelerator: Any = None) -> Self:
        """The agent of a checkpoint; see ``loadCheckpoint``."""
        found = cls.__new__(cls)
        found.loadCheckpoint(path)
        found.device = device
        return found

    save_checkpoint, load_checkpoint = saveCheckpoint, loadCheckpoint


def random_seed() -> int:
    """A seed from torch's generator: ``torch.manual_seed`` decides about all that follows."""
    return int(torch.randint(2**62, ()))


def _observations(given: dict[str, Any]) -> gym.Space[Any]:
    size, network = [int(n) for n in np.atleast_1d(given["state_dim"])], given["net_config"]
    if given["one_hot"]:
        return gym.spaces.Discrete(size[0])
    if network["arch"] == "cnn" and network.get("normalize", True):
        return gym.spaces.Box(0, 255, size, np.uint8)
    low, high = (0.0, 1.0) if network["arch"] == "cnn" else (-np.inf, np.inf)
    return gym.spaces.Box(low, high, size, np.float32)


def _network(given: dict[str, Any], usual: str) -> Network:
    name = given.get("mlp_activation") or usual
    if (
        given.get("arch") not in ("mlp", "cnn")
        or "hidden_size" not in given
        or name not in ACTIVATIONS
    ):
        raise SkillweaveError(
            f"net_config is {given}; it must have arch ('mlp' or 'cnn') and hidden_size, and "
            f"mlp_activation, if any, be one of {', '.join(ACTIVATIONS)}"
        )
    sizes = [tuple(given.get(f"{k}_size", ())) for k in ("channel", "kernel", "stride")]
    rest: Any = bool(given.get("layer_norm")), CNN("plain", *sizes) if sizes[0] else None
    return Network(tuple(given["hidden_size"]), ACTIVATIONS[name], *rest)  # type: ignore[arg-type]


def plain(value: Any) -> Any:
    """NumPy's numbers and arrays as Python's."""
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value
