"""The base of all agents: one that acts, learns and is a file, under AgileRL's names."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Self

import gymnasium as gym
import numpy as np
import torch

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import (
    AgentHeader,
    AgentPolicy,
    check_finite,
    make_algorithm,
    state_from,
)
from skillweave.algorithms.batches import Sample
from skillweave.errors import DeclarationError, RunError
from skillweave.evolution.mutation import with_settings
from skillweave.evolution.stacks import Member, copy
from skillweave.networks.config import CNN, Network
from skillweave.policies.core import Array
from skillweave.policies.untrusted import check_file, shown
from skillweave.runs.files import read_tensors, record_in, write_tensors
from skillweave.spaces import to_tensor

MLP: dict[str, Any] = {"arch": "mlp", "hidden_size": [64, 64]}
ACTIVATIONS = {"Tanh": "tanh", "ReLU": "relu", "ELU": "elu", "SiLU": "silu", "GELU": "gelu"}
_PAST = ("scores", "fitness", "steps", "mut", "index", "beta", "prior_eps")


class Setting:
    """An attribute in place of a field of the native config; ``inverse``: it is 1 / field."""

    def __init__(self, field: str, inverse: bool = False) -> None:
        self.field = field
        self.inverse = inverse

    def __get__(self, agent: AgilerlAgent | None, owner: type) -> Any:
        if agent is None:
            return self
        value = getattr(agent.member.config, self.field)
        return round(1.0 / value) if self.inverse else value

    def __set__(self, agent: AgilerlAgent, value: Any) -> None:
        agent.set(**self.native(value))

    def native(self, value: Any) -> dict[str, Any]:
        """Return the native field for AgileRL's ``value``, which may be a number of NumPy's."""
        value = value.tolist() if isinstance(value, np.generic | np.ndarray) else value
        return {self.field: 1.0 / float(value) if self.inverse else value}


class AgilerlAgent:
    """An agent with AgileRL's interface: a member of P = 1 with its history."""

    algo: ClassVar[str]
    kind: ClassVar[Any]
    fixed: ClassVar[dict[str, Any]] = {}
    """Fields of the native config that AgileRL has no name for, with what it does."""
    getAction: Any
    get_action: Any
    batch_size = Setting("batch_size")
    gamma = Setting("gamma")
    mut: str | None
    member: Any
    learner: Any

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
        network = given["net_config"]
        settings["network"] = network_of(network, "Tanh" if self.algo == "PPO" else "ReLU")
        seen = observations_of(given["state_dim"], given["one_hot"], network)
        config = self.config_of(given, make, **settings)
        seeds = Seeds(random_seed())
        state = make_algorithm(config, seen, actions).init([seeds])
        self.take(Member(0, config, state), (seen, actions), seeds)
        self.index = given["index"]
        self.mut = given["mut"]
        self.device = given["device"]

    @classmethod
    def config_of(cls, given: Mapping[str, Any], make: Any = None, **settings: Any) -> Any:
        """Return the native config for AgileRL's settings, ``given`` by name.

        Args:
            make: returns the config; None: its class.
            settings: further fields.
        """
        config = {"normalize_obs": False} | cls.fixed  # AgileRL does not normalize
        for name, value in given.items():
            if isinstance(setting := getattr(cls, name, None), Setting):
                config |= setting.native(value)
        return (make or cls.kind)(**config | settings)

    def take(self, member: Member, spaces: tuple[Any, Any], seeds: Seeds) -> None:
        """Begin as a member on (observation space, action space), without a history.

        Args:
            seeds: the root of its random streams.
        """
        self.spaces = spaces
        self.seeds = seeds
        self.rng = (seeds / "act").numpy()
        self.generator = (seeds / "learn").torch()
        self.updates = 0
        self.become(member)
        self.scores: list[float] = []
        self.fitness: list[float] = []
        self.index = 0
        self.mut = None
        self.steps = [0]
        self.device = "cpu"
        seen, actions = spaces
        self.one_hot = not seen.shape
        self.discrete_actions = not actions.shape
        self.state_dim = seen.shape or (int(seen.n),)
        self.action_dim = int(actions.shape[0] if actions.shape else actions.n)

    def become(self, member: Member) -> None:
        """Continue as another member, for example a mutated one."""
        self.member = member
        self.learner = member.algorithm(self.spaces)

    def set(self, **settings: Any) -> None:
        """Change fields of the native config."""
        self.become(with_settings(self.member, **settings))

    def rows(self, obs: Any) -> Array:
        """Return observations, however nested, as (B, *shape) with the dtype of the space."""
        space = self.spaces[0]
        return np.asarray(obs, space.dtype).reshape(-1, *space.shape)

    def act(
        self, obs: Any, *, explore: bool = True, epsilon: float = 0.0, mask: Any = None
    ) -> Array:
        """Return actions (B, ...) in the environment's units.

        Args:
            explore: the algorithm adds its own exploration.
            epsilon: probability that all actions are drawn uniformly instead.
            mask: (A,) or (B, A), allowed actions.
        """
        rows = self.rows(obs)
        learner = self.learner
        allowed = None
        if mask is not None:
            allowed = torch.from_numpy(np.asarray(mask, bool).reshape(-1, learner.codec.size))
            allowed = allowed.expand(len(rows), -1)[None]
        with torch.inference_mode():
            if epsilon and self.rng.random() < epsilon:
                action = learner.random_actions([self.generator], len(rows), allowed)
            else:
                actor = learner.acting_params(self.member.state)
                if "epsilon" in actor.extra:  # here it comes at each call, instead
                    actor.extra["epsilon"].zero_()
                noise = learner.noise([self.generator], 1, len(rows))[0] if explore else None
                action, _, _ = learner.act(actor, to_tensor(rows)[None], allowed, noise)
        actions: Array = learner.to_env(action[0].numpy())
        return actions

    def learn_sample(
        self, gamma: float, transitions: Any, weight: Any = None
    ) -> tuple[dict[str, float], Array]:
        """Make one gradient step; return metrics and the errors (B,).

        Args:
            gamma: of all steps of a transition.
            transitions: states, actions, rewards, next states, terminations of B transitions.
            weight: (B,), of each in the loss.
        """
        obs, action, reward, after, ended = transitions
        rewards = tensor_of(reward, np.float32).view(1, -1)
        size = rewards.shape[1]
        shape = self.spaces[1].shape or ()
        units = self.learner.codec.from_env(np.asarray(action).reshape(size, *shape))
        sample = Sample(
            to_tensor(self.rows(obs))[None],
            torch.from_numpy(units)[None],
            rewards,
            gamma * (1.0 - tensor_of(ended, np.float32).view(1, -1)),
            to_tensor(self.rows(after))[None],
            None,
            None,
            None if weight is None else tensor_of(weight, np.float32).view(1, -1),
            np.arange(size)[None],
        )
        _, report = self.learner.update(self.member.state, sample, [self.generator])
        return {k: float(v) for k, v in report.metrics.items()}, report.error[0].numpy()

    def test(
        self, env: Any, swap_channels: bool = False, max_steps: int = 500, loop: int = 3
    ) -> float:
        """Append to ``fitness`` and return the mean return of ``loop`` episodes.

        In a vector environment only the first environment counts.
        """
        returns = np.zeros(loop)
        for i in range(loop):
            state = env.reset()[0]
            for _ in range(max_steps):
                action = self.getAction(swapped(state, swap_channels))
                action = action[0] if isinstance(action, tuple) else action
                state, *step = env.step(action if hasattr(env, "num_envs") else action[0])
                reward, terminated, truncated = (np.ravel(x)[0] for x in step[:3])
                returns[i] += reward
                if terminated or truncated:
                    break
        self.fitness.append(float(returns.mean()))
        return self.fitness[-1]

    def clone(self, index: int | None = None, wrap: bool = True) -> Self:
        """Return a copy of the agent with its own random streams."""
        twin = type(self).__new__(type(self))
        twin.take(copy(self.member), self.spaces, Seeds(random_seed()))
        twin.__dict__.update(self._past(), device=self.device)
        twin.index = self.index if index is None else index
        return twin

    def _past(self) -> dict[str, Any]:
        return {k: np.array(getattr(self, k)).tolist() for k in _PAST if hasattr(self, k)}

    def saveCheckpoint(self, path: str | Path) -> None:
        """Write the native agent and its history, as safetensors and JSON whatever the suffix."""
        state = self.member.state
        tensors, header = AgentPolicy.of(self.learner, state).to_file()
        tensors = tensors | {f"state.{k}": v for k, v in vars(state).items()}
        about = {"algo": self.algo, **self._past()}
        write_tensors(Path(path), tensors, replace(header, about=about))

    def loadCheckpoint(self, path: str | Path) -> None:
        """Become the agent of a checkpoint, or of any file with a native agent of this kind.

        A file that holds a policy alone gives the weights; everything else starts fresh.

        Raises:
            RunError: the file is missing, damaged, a pickle of AgileRL's, or another algorithm's.
        """
        check_file(Path(path))
        if zipfile.is_zipfile(path):
            raise RunError(
                f"{path} is a pickle of torch.save's, and a pickle can run code. If it is a "
                "checkpoint of AgileRL's and you trust where it comes from, convert it: skillweave "
                f"import-agilerl {path} --trust"
            )
        tensors, header = read_tensors(Path(path))
        of: AgentHeader = record_in(AgentHeader, header, path)
        learner: Any = AgentPolicy.from_file(tensors, of, str(path)).algorithm
        past = dict(of.about)
        algo = past.pop("algo", self.algo)
        if not isinstance(learner.config, self.kind) or algo != self.algo:
            kind = type(learner.config).__name__
            raise RunError(f"{path} holds an agent of {kind} ({algo}), not of {self.algo}")
        seeds = Seeds(random_seed())
        state = learner.init([seeds])
        learner.set_weights(state, tensors)
        saved = {k[len("state.") :]: v for k, v in tensors.items() if k.startswith("state.")}
        if saved:
            saved = vars(state) | saved
            state = state_from(saved, state, str(path), learner.parameter_groups())
            check_finite(vars(state), str(path))
        spaces = learner.observation_space, learner.action_space
        self.take(Member(0, learner.config, state), spaces, seeds)
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


def observations_of(
    size: Any, one_hot: bool | None, net_config: Mapping[str, Any]
) -> gym.Space[Any]:
    """Return the observation space of states of this size, for a network of this description."""
    shape = [int(n) for n in np.atleast_1d(size)]
    if one_hot:
        return gym.spaces.Discrete(shape[0])
    if net_config.get("arch") != "cnn":
        return gym.spaces.Box(-np.inf, np.inf, shape, np.float32)
    if net_config.get("normalize", True):
        return gym.spaces.Box(0, 255, shape, np.uint8)
    return gym.spaces.Box(0.0, 1.0, shape, np.float32)


def network_of(described: Mapping[str, Any], usual: str | None = None) -> Network:
    """Return the network that a ``net_config`` of AgileRL describes.

    Args:
        usual: the activation where none is described.

    Raises:
        RunError: a part is missing or unknown.
    """
    name = described.get("mlp_activation") or described.get("activation") or usual
    known = described.get("arch") in ("mlp", "cnn") and name in ACTIVATIONS
    if not known or "hidden_size" not in described:
        raise RunError(
            f"a network is described by {shown(dict(described), 500)}; it must have a hidden_size, "
            f"arch be 'mlp' or 'cnn', and its activation be one of {', '.join(ACTIVATIONS)}"
        )
    sizes = [tuple(described.get(f"{k}_size", ())) for k in ("channel", "kernel", "stride")]
    cnn = CNN("plain", *sizes) if sizes[0] else None
    layer_norm = bool(described.get("layer_norm"))
    activation: Any = ACTIVATIONS[str(name)]
    planes: Any = None if cnn is None else "first"  # the layout of all images in AgileRL
    widths = tuple(int(n) for n in described["hidden_size"])
    return Network(widths, activation, layer_norm, cnn, planes=planes)


def random_seed() -> int:
    """Return a seed from torch's generator, which ``torch.manual_seed`` repeats."""
    return int(torch.randint(2**62, (), device="cpu"))


def swapped(state: Any, swap: bool) -> Any:
    """Return observations, with the channels moved to the front if ``swap``."""
    return np.moveaxis(state, -1, -3) if swap else state


def tensor_of(values: Any, kind: Any) -> torch.Tensor:
    """Return values, however nested, as a tensor with this dtype of NumPy's."""
    return torch.from_numpy(np.ascontiguousarray(np.asarray(values), kind))
