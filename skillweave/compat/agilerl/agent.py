"""The base of all agents: a native agent under AgileRL's names, with its history."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Self

import gymnasium as gym
import numpy as np
import torch

from skillweave.compat.agilerl_files import network_of, observations_of
from skillweave.compat.batches import returns_of
from skillweave.compat.single_agent import SingleAgent
from skillweave.errors import DeclarationError, RunError
from skillweave.evolution.stacks import Member

MLP: dict[str, Any] = {"arch": "mlp", "hidden_size": [64, 64]}
_PAST = ("scores", "fitness", "steps", "mut", "index", "beta", "prior_eps")


class Setting:
    """An attribute in place of a field of the native config.

    ``inverse``: its value is 1 / field; ``share``: field times the field of this name.
    """

    def __init__(self, field: str, inverse: bool = False, share: str | None = None) -> None:
        self.field = field
        self.inverse = inverse
        self.share = share

    def __get__(self, agent: Agent | None, owner: type) -> Any:
        if agent is None:
            return self
        value = getattr(agent.native.member.config, self.field)
        value = value * getattr(agent.native.member.config, self.share) if self.share else value
        return round(1.0 / value) if self.inverse else value

    def __set__(self, agent: Agent, value: Any) -> None:
        whole = getattr(agent.native.member.config, self.share) if self.share else None
        agent.native.set(**self.native(value / whole if whole else value))

    def native(self, value: Any) -> dict[str, Any]:
        """Return the native field for AgileRL's ``value``."""
        return {self.field: 1.0 / float(value) if self.inverse else plain(value)}


class Agent:
    """An agent with AgileRL's interface; ``native`` does all acting and learning."""

    algo: ClassVar[str]
    kind: ClassVar[type]
    getAction: Any
    get_action: Any
    batch_size = Setting("batch_size")
    gamma = Setting("gamma")
    mut: str | None

    def __init_subclass__(cls) -> None:
        cls.get_action = cls.getAction

    def _start(
        self, given: Any, actions: gym.Space[Any], make: Any = None, **settings: Any
    ) -> None:
        """Start with fresh weights; ``given`` are the constructor's arguments."""
        for name, value in given.items():
            if (name == "accelerator" or "_network" in name) and value is not None:
                raise DeclarationError(
                    f"{self.algo}({name}=...) is not supported; for networks beyond net_config "
                    "see register_encoder of the native API"
                )
            if isinstance(setting := getattr(type(self), name, None), Setting):
                settings = setting.native(value) | settings
        network = given["net_config"]
        settings["normalize_obs"] = False  # AgileRL does not
        settings["network"] = network_of(network, "Tanh" if self.algo == "PPO" else "ReLU")
        seen = observations_of(given["state_dim"], given["one_hot"], network)
        self._wrap(
            SingleAgent(
                Member(0, (make or self.kind)(**settings), None), (seen, actions), random_seed()
            )
        )
        self.index = given["index"]
        self.mut = given["mut"]
        self.device = given["device"]

    def _wrap(self, native: SingleAgent) -> None:
        self.native = native
        (seen, action_space) = native.spaces
        self.scores: list[float] = []
        self.fitness: list[float] = []
        self.index = 0
        self.mut = None
        self.steps = [0]
        self.device = "cpu"
        self.one_hot = not seen.shape
        self.discrete_actions = not action_space.shape
        self.state_dim = seen.shape or (int(seen.n),)
        self.action_dim = int(action_space.shape[0] if action_space.shape else action_space.n)

    def test(
        self, env: Any, swap_channels: bool = False, max_steps: int = 500, loop: int = 3
    ) -> float:
        """Append to ``fitness`` and return the mean return of ``loop`` episodes."""

        def act(state: Any) -> Any:
            action = self.getAction(swapped(state, swap_channels))
            return action[0] if isinstance(action, tuple) else action

        self.fitness.append(float(returns_of(env, act, loop, max_steps).mean()))
        return self.fitness[-1]

    def clone(self, index: int | None = None, wrap: bool = True) -> Self:
        """Return a copy of the agent with its own random streams."""
        copy = type(self).__new__(type(self))
        copy._wrap(self.native.copy(random_seed()))
        copy.__dict__.update(self._past(), device=self.device)
        copy.index = self.index if index is None else index
        return copy

    def _past(self) -> dict[str, Any]:
        return {k: np.array(getattr(self, k)).tolist() for k in _PAST if hasattr(self, k)}

    def saveCheckpoint(self, path: str | Path) -> None:
        """Write the native agent and its history, as safetensors and JSON whatever the suffix."""
        self.native.save(path, {"algo": self.algo, **self._past()})

    def loadCheckpoint(self, path: str | Path) -> None:
        """Become the agent of a checkpoint, or of any file with a native agent of this kind.

        Raises:
            RunError: the file is missing, a pickle of AgileRL's, or another algorithm's.
        """
        native, past = SingleAgent.load(path, random_seed())
        algo = past.pop("algo", self.algo)
        if not isinstance(native.member.config, self.kind) or algo != self.algo:
            kind = type(native.member.config).__name__
            raise RunError(f"{path} holds an agent of {kind} ({algo}), not of {self.algo}")
        self._wrap(native)
        self.__dict__.update(past)

    @classmethod
    def load(cls, path: str | Path, device: Any = "cpu", accelerator: Any = None) -> Self:
        """Return the agent in a checkpoint; see ``loadCheckpoint``."""
        agent = cls.__new__(cls)
        agent.loadCheckpoint(path)
        agent.device = device
        return agent

    save_checkpoint = saveCheckpoint
    load_checkpoint = loadCheckpoint


def random_seed() -> int:
    """Return a seed from torch's generator, which ``torch.manual_seed`` repeats."""
    return int(torch.randint(2**62, (), device="cpu"))


def plain(value: Any) -> Any:
    """Return NumPy numbers and arrays as Python's."""
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value


def swapped(state: Any, swap: bool) -> Any:
    """Return observations, with the channels moved to the front if ``swap``."""
    return np.moveaxis(state, -1, -3) if swap else state
