"""Stable-Baselines3 models as policies.

Stands alone because it is one kind of foreign policy, as ``onnx_file`` and ``torch_module`` are.
"""

from __future__ import annotations

import copy
import io
from pathlib import Path
from typing import Any, Self

import numpy as np
from gymnasium import Env, Space
from gymnasium.spaces import Box, Dict

from skillweave.arguments import checked_names
from skillweave.errors import DeclarationError, MissingExtra, PolicyError
from skillweave.messages import error_text, short, shortened
from skillweave.reading import check_file, read_file
from skillweave.skills.foreign_policy import checksum
from skillweave.skills.mapped import MappedPolicy
from skillweave.skills.mapping import Part, PolicyMapping, Scaling, mapping_of
from skillweave.skills.plan import Shapes
from skillweave.skills.torch_module import weights_of, with_weights
from skillweave.types import Array

ALGORITHMS = ("ppo", "a2c", "dqn", "sac", "td3", "ddpg")


class SB3Policy(MappedPolicy):
    """The policy of a Stable-Baselines3 model; without a mapping it acts on the model's own spaces.

    Samples are from the policy's distribution; DQN's exploration belongs to its training.
    """

    kind = "sb3"
    suffix = ".safetensors"
    logits = False

    def __init__(
        self,
        model: Any,
        file: Path | None = None,
        sha256: str | None = None,
        mapping: PolicyMapping | None = None,
    ) -> None:
        self.algorithm = type(model).__name__
        name = f"Stable-Baselines3's {self.algorithm}" + (f" of {file}" if file else "")
        mapping = mapping or PolicyMapping()
        self.model_space = model.observation_space
        seen = None if mapping.sees is not None else model.observation_space
        taken = None if mapping.acts is not None else model.action_space
        super().__init__(name, seen, taken, mapping)
        self.policy = model.policy
        self.file = file
        self.sha256 = sha256
        if hasattr(self.policy, "lstm_actor"):
            raise PolicyError(
                f"{name} has a recurrent policy, whose state predict() would forget here: give its "
                "network as a module that takes and returns the state, from_torch(..., state=...)"
            )

    def bind(self, observation_space: Space[Any], action_space: Space[Any], who: str) -> Self:
        """Return a copy; images may have their channels last if the model transposes them."""
        bound = super().bind(observation_space, action_space, who)
        bound.policy = copy.deepcopy(self.policy)
        mine = self.model_space
        theirs = observation_space
        if (
            self.mapping.sees is None
            and isinstance(mine, Box)
            and isinstance(theirs, Box)
            and len(theirs.shape) == 3
            and mine.dtype == theirs.dtype == np.uint8
            and mine.shape == (theirs.shape[2], *theirs.shape[:2])
        ):
            bound.observation_space = theirs
        return bound

    def expected(self) -> Shapes:
        """Return the shapes of the model's observations."""
        space = self.model_space
        parts = dict(space.spaces) if isinstance(space, Dict) else {"": space}
        return {
            # predict() moves the channels of images itself.
            name: None if len(part.shape or ()) == 3 else tuple(part.shape or ())
            for name, part in parts.items()
        }

    def call(
        self,
        inputs: Any,
        state: tuple[Array, ...],
        mask: Array | None,
        deterministic: bool,
        rng: np.random.Generator | None,
    ) -> tuple[Array, tuple[Array, ...]]:
        """Return the model's actions, by its own ``predict``."""
        import torch

        from skillweave.spaces import unpack

        if isinstance(inputs, dict):
            parts: Any = inputs.get("", inputs)
        else:
            parts = unpack(self.observation_space, inputs)
        if deterministic:
            return self.policy.predict(parts, deterministic=True)[0], ()
        # It samples from torch's global generator, which other code may use.
        rng = rng or np.random.default_rng()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(rng.integers(2**62)))
            return self.policy.predict(parts, deterministic=False)[0], ()

    def source(self) -> dict[str, Any]:
        """Return a zip's path and checksum, or the checksum of weights; and the mapping."""
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
def from_sb3(
    model: Any,
    algorithm: str | type | None = None,
    *,
    trust: bool = False,
    normalize: Any = None,
    sees: Any = None,
    goal: Any = None,
    acts: Any = None,
    every: int = 1,
) -> SB3Policy:
    """Return a Stable-Baselines3 model as a skill's policy.

    The run records a zip's path and checksum, without a copy; it copies the weights of a model in
    memory.

    Args:
        model: a zip that Stable-Baselines3 saved, or a model in memory.
        algorithm: of a zip: "ppo", "a2c", "dqn", "sac", "td3", "ddpg", or the class that saved it.
        trust: True if you trust the author: opening the files may run any code in them.
        normalize: the ``VecNormalize`` that scaled observations in training, or the file in which
            it was saved; its statistics become a part of the mapping. The zip does not hold them.
        sees: the parts of the observation that the model takes; of a model with Dict observations
            a list for each part by name; see ``from_onnx``.
        goal: the value of ``Goal()`` in ``sees``; see ``from_onnx``.
        acts: the meaning of the model's actions, ``Acts(...)``; None: they are the environment's.
        every: each action is held for this number of steps.

    Returns:
        The policy, for a skill's ``policy`` or ``evaluate``.

    Raises:
        PolicyError: a file is not trusted, or holds no such model.
        RunError: a file does not exist.
        DeclarationError: an argument has a wrong type.
    """
    options = {"sees": sees, "goal": goal, "acts": acts, "every": every}
    if not isinstance(model, str | Path):
        if not (hasattr(model, "policy") and hasattr(model, "observation_space")):
            raise DeclarationError(
                f"{short(model)} is neither a Stable-Baselines3 model nor the path of one"
            )
        return SB3Policy(model, mapping=_mapping(model, normalize, trust, options))
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
    return SB3Policy(loaded, file, checksum(content), _mapping(loaded, normalize, trust, options))


def _mapping(model: Any, normalize: Any, trust: bool, options: dict[str, Any]) -> PolicyMapping:
    """Return the declared mapping, with the statistics of ``VecNormalize`` in it."""
    scaling: dict[str, Scaling] = {}
    if normalize is not None:
        spaces = model.observation_space, model.action_space
        scaling = _statistics(normalize, trust, *spaces)
    if scaling and options["sees"] is None:
        space = model.observation_space
        whole: Any = Part(one_hot=False)
        if isinstance(space, Dict):
            whole = {name: Part(name, one_hot=False) for name in space.spaces}
        options = options | {"sees": whole}
    return mapping_of("from_sb3()", **options, scaling=scaling)


def _opened_statistics(file: Path, space: Space[Any], action_space: Space[Any]) -> Any:
    """Return the ``VecNormalize`` in a file, for a model with these spaces."""
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    # VecNormalize compares the spaces of its environment, and no more.
    spaces = {"observation_space": space, "action_space": action_space}
    stub: Any = type("Stub", (Env,), spaces)
    check_file(file)
    try:
        return VecNormalize.load(str(file), DummyVecEnv([stub]))
    except (Exception, SystemExit) as error:
        raise PolicyError(
            f"{file} could not be opened as the VecNormalize of observations {space}: "
            f"{error_text(error)}"
        ) from error


def _statistics(
    normalize: Any, trust: bool, space: Space[Any], action_space: Space[Any]
) -> dict[str, Scaling]:
    """Return the scaling of observations by ``VecNormalize``, by the name of the input."""
    if isinstance(normalize, str | Path):
        file = Path(normalize)
        if trust is not True:
            raise PolicyError(
                f"{file} was not opened: VecNormalize is saved as a pickle, which can run any code "
                "on your machine. If you trust its author, add trust=True"
            )
        normalize = _opened_statistics(file, space, action_space)
    rms: Any = getattr(normalize, "obs_rms", None)
    if not getattr(normalize, "norm_obs", True):
        return {}
    by_name = dict(rms) if isinstance(rms, dict) else {"": rms}
    parts = dict(space.spaces) if isinstance(space, Dict) else {"": space}
    shapes = {name: np.shape(getattr(one, "mean", 0.0)) for name, one in by_name.items()}
    if any(name not in parts or parts[name].shape != shape for name, shape in shapes.items()):
        raise DeclarationError(
            f"normalize is {short(normalize)}; it must be the VecNormalize of the model, with "
            f"statistics of observations {space}"
        )
    limit = float(normalize.clip_obs)
    return {
        name: Scaling(
            offset=np.ravel(one.mean),
            scale=1.0 / np.sqrt(np.ravel(one.var) + normalize.epsilon),
            clip=(-limit, limit),
        )
        for name, one in by_name.items()
    }


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
