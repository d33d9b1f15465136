"""Stable-Baselines3 models as policies.

Stands alone because it is one kind of foreign policy, as ``onnx_file`` and ``torch_module`` are.
"""

from __future__ import annotations

import copy
import io
from pathlib import Path
from typing import Any, Self

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box

from skillweave.arguments import checked_names
from skillweave.errors import DeclarationError, MissingExtra, PolicyError
from skillweave.messages import short, shortened
from skillweave.reading import read_file
from skillweave.skills.foreign_policy import Foreign, checksum
from skillweave.skills.outputs import checked_actions
from skillweave.skills.torch_module import weights_of, with_weights
from skillweave.types import Array, Memory

ALGORITHMS = ("ppo", "a2c", "dqn", "sac", "td3", "ddpg")


class SB3Policy(Foreign):
    """The policy of a Stable-Baselines3 model; it acts on the model's own spaces.

    Samples are from the policy's distribution; DQN's exploration belongs to its training.
    """

    kind = "sb3"
    suffix = ".safetensors"

    def __init__(self, model: Any, file: Path | None = None, sha256: str | None = None) -> None:
        self.algorithm = type(model).__name__
        name = f"Stable-Baselines3's {self.algorithm}" + (f" of {file}" if file else "")
        super().__init__(name, model.observation_space, model.action_space)
        self.policy, self.file, self.sha256 = model.policy, file, sha256

    def bind(self, observation_space: Space[Any], action_space: Space[Any], who: str) -> Self:
        """Return a copy; images may have their channels last if the model transposes them."""
        bound = super().bind(observation_space, action_space, who)
        bound.policy = copy.deepcopy(self.policy)
        mine, theirs = self.observation_space, observation_space
        if (
            isinstance(mine, Box)
            and isinstance(theirs, Box)
            and len(theirs.shape) == 3
            and mine.dtype == theirs.dtype == np.uint8
            and mine.shape == (theirs.shape[2], *theirs.shape[:2])
        ):
            bound.observation_space = theirs
        return bound

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Return the model's actions, by its own ``predict``."""
        import torch

        from skillweave.spaces import unpack

        parts = unpack(self.observation_space, obs)
        if deterministic:
            action = self.policy.predict(parts, deterministic=True)[0]
        else:
            # It samples from torch's global generator, which other code may use.
            rng = rng or np.random.default_rng()
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(int(rng.integers(2**62)))
                action = self.policy.predict(parts, deterministic=False)[0]
        return checked_actions(action, len(obs), self.action_space, self._who), memory

    def source(self) -> dict[str, Any]:
        """Return the zip's path and checksum; for a model in memory, its weights' checksum."""
        where = {"file": str(self.file), "sha256": self.sha256} if self.file else {}
        return super().source() | {"name": self.algorithm} | where

    def content(self) -> bytes | None:
        """Return the weights of a model in memory; None for a zip, which can run code."""
        return None if self.file else weights_of(self.policy, self._who)

    def restored(self, content: bytes) -> Self:
        """Return a copy with these weights."""
        policy = copy.copy(self)
        policy.policy = with_weights(self.policy, content, self._who)
        return policy


@checked_names
def from_sb3(model: Any, algorithm: str | type | None = None, *, trust: bool = False) -> SB3Policy:
    """Return a Stable-Baselines3 model as a skill's policy.

    The run records a zip's path and checksum, without a copy; it copies the weights of a model in
    memory. If ``VecNormalize`` scaled observations, the environment must scale them: the zip does
    not hold those statistics.

    Args:
        model: a zip that Stable-Baselines3 saved, or a model in memory.
        algorithm: of a zip: "ppo", "a2c", "dqn", "sac", "td3", "ddpg", or the class that saved it.
        trust: True if you trust the author: opening the zip may run any code in it.

    Returns:
        The policy, for a skill's ``policy`` or ``evaluate``.

    Raises:
        PolicyError: the zip is not trusted, or holds no such model.
        RunError: the zip does not exist.
        DeclarationError: ``model`` or ``algorithm`` has a wrong type.
    """
    if not isinstance(model, str | Path):
        if not (hasattr(model, "policy") and hasattr(model, "observation_space")):
            raise DeclarationError(
                f"{short(model)} is neither a Stable-Baselines3 model nor the path of one"
            )
        return SB3Policy(model)
    file = Path(model)
    if trust is not True:
        raise PolicyError(
            f"{file} was not opened: a Stable-Baselines3 zip holds pickles, which can run any code "
            "on your machine. If you trust its author: "
            f"from_sb3({str(file)!r}, {algorithm!r}, trust=True)"
        )
    kind = _algorithm(algorithm, file)
    content = read_file(file)
    # A replay buffer is for training only, and may take gigabytes.
    less = {"buffer_size": 1} if _learns_off_policy(kind) else {}
    try:
        loaded = kind.load(io.BytesIO(content), device="cpu", **less)
    except Exception as error:
        raise PolicyError(
            f"{file} could not be opened as Stable-Baselines3's {kind.__name__}: "
            f"{type(error).__name__}: {shortened(str(error))}"
        ) from error
    return SB3Policy(loaded, file, checksum(content))


def _algorithm(algorithm: str | type | None, file: Path) -> Any:
    try:
        import stable_baselines3
    except ImportError as error:
        raise MissingExtra("a Stable-Baselines3 model", "sb3") from error
    if isinstance(algorithm, type) and hasattr(algorithm, "load"):
        return algorithm
    if isinstance(algorithm, str) and algorithm.lower() in ALGORITHMS:
        return getattr(stable_baselines3, algorithm.upper())
    raise DeclarationError(
        f"{file}: algorithm is {algorithm!r}; it must be the class that saved the file, or one of "
        f"{', '.join(ALGORITHMS)}"
    )


def _learns_off_policy(kind: type) -> bool:
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

    return issubclass(kind, OffPolicyAlgorithm)
