"""Stable-Baselines3 models as policies."""

from __future__ import annotations

import io
import zipfile
from inspect import signature
from pathlib import Path
from typing import Any, Literal, Self, overload

import numpy as np
from gymnasium import Env, Space
from gymnasium.spaces import Box, Dict, MultiBinary

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import error_text, short, shortened
from skillweave._internal.notices import notice
from skillweave.errors import DeclarationError, PolicyError, needs_extra
from skillweave.policies.core import Array, Turn
from skillweave.policies.mapped import Mapped, Shapes
from skillweave.policies.untrusted import check_file, checksum, read_file
from skillweave.schema import fitted
from skillweave.skills.foreign_policy import made_up
from skillweave.skills.learnable import PLAIN_PPO, Learnable, array_of, layers_of, no_mapping
from skillweave.skills.mapping import Part, PolicyMapping, Scaling, mapping_of
from skillweave.skills.torch_module import TorchPolicy

ALGORITHMS = {"PPO": "PPO", "A2C": "PPO", "DQN": "DQN", "SAC": "SAC", "TD3": "TD3", "DDPG": "TD3"}
"""The algorithms of Stable-Baselines3, with those of this library by which a model learns on."""


class SB3Policy(TorchPolicy):
    """The policy of a Stable-Baselines3 model; without a mapping it acts on the model's own spaces.

    Samples are from the policy's distribution; DQN's exploration belongs to its training. A model
    whose ``predict`` takes ``action_masks`` gets the environment's mask.
    """

    kind = "sb3"
    logits = False

    def __init__(
        self, model: Any, name: str, origin: dict[str, str], mapping: PolicyMapping
    ) -> None:
        seen = None if mapping.sees is not None else model.observation_space
        taken = None if mapping.acts is not None else model.action_space
        super().__init__(model.policy, seen, taken, mapping)
        self.model_space = model.observation_space
        self.name = self._who = name
        self.label = type(model).__name__
        self.origin = origin
        if hasattr(model.policy, "lstm_actor"):
            raise PolicyError(
                f"{name} has a recurrent policy, whose state predict() would forget here: give its "
                "network as a module that takes and returns the state, from_torch(..., state=...)"
            )

    def bind(self, observation_space: Space[Any], action_space: Space[Any], who: str) -> Self:
        """Return a copy; images may have their channels last if the model transposes them."""
        bound = super().bind(observation_space, action_space, who)
        mine = self.model_space
        theirs = observation_space
        bytes_alone = mine.dtype == theirs.dtype == np.uint8
        if self.mapping.sees is None and bytes_alone and theirs.shape and len(theirs.shape) == 3:
            height, width, channels = theirs.shape
            if mine.shape == (channels, height, width):
                bound.observation_space = theirs
        return bound

    def _own_module(self) -> Any:
        """Return a copy of the model's policy.

        After training its latest distribution is part of a graph, which cannot be copied; acting
        once replaces it.
        """
        import torch

        from skillweave.spaces import unpack

        policy, space = self.module, self.model_space
        with torch.random.fork_rng(devices=[]):
            _reset_noise(policy, 1)
        policy.predict(unpack(space, made_up(space, 1)), deterministic=True)
        return super()._own_module()

    @property
    def expected(self) -> Shapes:
        """The shapes of the model's observations."""
        space = self.model_space
        parts = dict(space.spaces) if isinstance(space, Dict) else {"": space}
        return {
            # predict() moves the channels of images itself.
            name: None if len(part.shape or ()) == 3 else tuple(part.shape or ())
            for name, part in parts.items()
        }

    def call(
        self, inputs: dict[str, Array], state: tuple[Array, ...], turn: Turn
    ) -> tuple[Array, tuple[Array, ...]]:
        """Return the model's actions, by its own ``predict``."""
        import torch

        from skillweave.spaces import unpack

        parts: Any = inputs.get("", inputs)
        if self.mapping.sees is None:
            parts = unpack(self.observation_space, parts)
        how = {}
        acting = self.in_place
        mask = None
        if turn.mask is not None and isinstance(acting, Mapped):
            mask = acting.outputs.allowed(turn.mask)
        if mask is not None and "action_masks" in signature(self.module.predict).parameters:
            how = {"action_masks": mask}
        try:
            if turn.greedy:
                return self.module.predict(parts, deterministic=True, **how)[0], ()
            # It samples from torch's global generator, which other code may use.
            rng = turn.world.rng or np.random.default_rng()
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(int(rng.integers(2**62)))
                _reset_noise(self.module, len(next(iter(inputs.values()))))
                return self.module.predict(parts, deterministic=False, **how)[0], ()
        except (Exception, SystemExit) as error:
            raise self._failure(error) from error


def _has_gsde(policy: Any) -> bool:
    """Return whether a policy has noise that depends on the state (``use_sde``)."""
    return bool(getattr(getattr(policy, "actor", policy), "use_sde", False))


def _reset_noise(policy: Any, n: int) -> None:
    """Draw gSDE's noise of a Stable-Baselines3 policy for n environments, outside of any graph."""
    import torch

    if _has_gsde(policy):
        with torch.no_grad():
            policy.reset_noise(n)


@overload
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
    learn: Literal[False] = False,
) -> SB3Policy: ...


@overload
def from_sb3(
    model: Any,
    algorithm: str | type | None = None,
    *,
    trust: bool = False,
    normalize: Any = None,
    learn: Literal[True],
) -> Learnable: ...


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
    learn: bool = False,
) -> SB3Policy | Learnable:
    """Return a Stable-Baselines3 model as a skill's policy.

    The run records a zip's path and checksum, without a copy; it copies the weights of a model in
    memory.

    With ``learn=True`` the skill is trained, and begins with the model's networks: PPO's and A2C's
    by ``PPO``, SAC's, TD3's, DDPG's and DQN's by the same algorithm, of SAC, TD3 and DDPG the actor
    alone. It keeps their layers (``MlpPolicy``); the other settings are those of the skill's
    ``algorithm``.

    Args:
        model: a zip that Stable-Baselines3 saved, or a model in memory.
        algorithm: of a zip: "ppo", "a2c", "dqn", "sac", "td3", "ddpg", or the class that saved it.
        trust: True if you trust the author: opening the files may run any code in them.
        normalize: the ``VecNormalize`` that scaled observations in training, or the file in which
            it was saved; its statistics become a part of the mapping. The zip does not hold them.
            None: the one that a model in memory still has. False: none.
        sees: the parts of the observation that the model takes; of a model with Dict observations
            a list for each part by name; see ``from_onnx``.
        goal: the value of ``Goal()`` in ``sees``; see ``from_onnx``.
        acts: the meaning of the model's actions, ``Acts(...)``; None: they are the environment's.
        every: each action is held for this number of steps.
        learn: the skill learns on from the model.

    Returns:
        The policy, for a skill's ``policy`` or ``evaluate``; with ``learn=True`` for a skill's
        ``policy`` or ``start_from``.

    Raises:
        PolicyError: a file is not trusted, or holds no such model, or no model that can learn on.
        RunError: a file does not exist.
        DeclarationError: an argument has a wrong type.
    """
    options = {"sees": sees, "goal": goal, "acts": acts, "every": every}
    fitted(bool, learn, "from_sb3(): learn")
    file = None
    origin = dict[str, str]()
    if isinstance(model, str | Path):
        file = Path(model)
        if trust is not True:
            check_file(file)
            kind_of = (
                algorithm.__name__ if isinstance(algorithm, type) else repr(algorithm or "ppo")
            )
            further = ", learn=True" if learn else ""
            raise PolicyError(
                f"{file} was not opened: a Stable-Baselines3 zip holds pickles, which can run any "
                "code on your machine. If you trust its author: "
                f"from_sb3({str(file)!r}, {kind_of}, trust=True{further})"
            )
        model, sha256 = _loaded(file, algorithm)
        origin = {"file": str(file), "sha256": sha256}
    elif not (hasattr(model, "policy") and hasattr(model, "observation_space")):
        raise DeclarationError(
            f"{short(model)} is neither a Stable-Baselines3 model nor the path of one"
        )
    name = f"Stable-Baselines3's {type(model).__name__}" + (f" of {file}" if file else "")
    scales = _statistics(normalize, model, file, trust)
    if learn:
        return _learnable(model, name, scales, options)
    return SB3Policy(model, name, origin, _mapping(model, scales, options))


def _loaded(file: Path, algorithm: str | type | None) -> tuple[Any, str]:
    """Return the Stable-Baselines3 model in a trusted file, and the file's checksum."""
    with needs_extra("a Stable-Baselines3 model", "sb3"):
        import stable_baselines3
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

    kind: Any = algorithm
    if isinstance(algorithm, str) and algorithm.upper() in ALGORITHMS:
        kind = getattr(stable_baselines3, algorithm.upper())
    if not (isinstance(kind, type) and hasattr(kind, "load")):
        raise DeclarationError(
            f"{file}: algorithm is {algorithm!r}; it must be the class that saved the file, or one "
            f"of {', '.join(ALGORITHMS).lower()}"
        )
    content = read_file(file)
    # A replay buffer is for training only, and may take gigabytes.
    less = {"buffer_size": 1} if issubclass(kind, OffPolicyAlgorithm) else {}
    try:
        return kind.load(io.BytesIO(content), device="cpu", **less), checksum(content)
    except Exception as error:
        raise PolicyError(
            f"{file} could not be opened as Stable-Baselines3's {kind.__name__}: "
            f"{type(error).__name__}: {shortened(' '.join(str(error).split()))}. "
            + _other_version(content, stable_baselines3.__version__)
        ) from error


def _statistics(normalize: Any, model: Any, file: Path | None, trust: bool) -> Any:
    """Return the ``VecNormalize`` of a model; None: its observations are not scaled.

    If a file beside the model's may hold it, a notice names that file.
    """
    if isinstance(normalize, str | Path):
        normalize = _opened(Path(normalize), trust, model)
    elif normalize is None and file is None:
        normalize = getattr(model, "get_vec_normalize_env", lambda: None)()
    elif normalize is None and file is not None:
        # RL Baselines3 Zoo has them in a folder of the zip's name.
        files = *file.parent.glob("*.pkl"), *file.with_suffix("").glob("*.pkl")
        if scales := sorted(str(f) for f in files if "normali" in f.name.lower()):
            notice(
                f"{file}: {scales[0]} may hold the scaling of its observations. If it was trained "
                f"so, add normalize={scales[0]!r}; normalize=False ends this message"
            )
    return normalize if normalize is not False and getattr(normalize, "norm_obs", True) else None


def _learnable(model: Any, name: str, normalize: Any, options: dict[str, Any]) -> Learnable:
    """Return the networks of a Stable-Baselines3 model, for a skill that learns on.

    Raises:
        PolicyError: its networks are of another kind.
        DeclarationError: a mapping is given.
    """
    kind = type(model).__name__
    policy = model.policy
    given = [k for k, v in options.items() if v is not None and v != 1]
    if given:
        raise DeclarationError(no_mapping(f"from_sb3(learn=True): {name}", " and ".join(given)))
    learns_by = ALGORITHMS.get(kind)
    if learns_by is None or hasattr(policy, "lstm_actor") or _has_gsde(policy):
        raise PolicyError(
            f"{name} cannot learn on: only the networks of {', '.join(ALGORITHMS)} without memory "
            "and without gSDE are known. Let it act as it is (without learn=True)"
        )
    if isinstance(model.action_space, MultiBinary):
        raise PolicyError(
            f"{name} cannot learn on: it has one output for each bit of {model.action_space}, and "
            "networks here have two. Let it act as it is (without learn=True)"
        )
    modules = (policy, *policy.children())
    extractors = (getattr(module, "features_extractor", None) for module in modules)
    extractor = next(x for x in extractors if x is not None)
    parts = getattr(extractor, "extractors", {"": extractor}).values()
    if other := {type(part).__name__ for part in parts} - {"FlattenExtractor", "Flatten"}:
        raise PolicyError(
            f"{name} cannot learn on: its observations pass through {', '.join(sorted(other))}, "
            "and only networks of linear layers are known. Let it act as it is (without learn=True)"
        )
    settings: dict[str, Any] = {}
    log_std = None
    if learns_by == "PPO":
        hidden = policy.mlp_extractor
        networks = {
            "actor": layers_of([hidden.policy_net, policy.action_net], name),
            "critic": layers_of([hidden.value_net, policy.value_net], name),
        }
        log_std = getattr(policy, "log_std", None)
        # The critic's values are in units of reward.
        settings = PLAIN_PPO | {"normalize_returns": False}
    elif kind == "DQN":
        networks = {"q": layers_of([policy.q_net.q_net], name)}
        settings = {"dueling": False, "noisy": False, "distributional": False}
    elif kind == "SAC":
        actor = policy.actor
        mean, spread = (layers_of([actor.latent_pi, x], name) for x in (actor.mu, actor.log_std))
        networks = {"actor": mean.beside(spread)}
    else:
        networks = {"actor": layers_of(list(policy.actor.mu)[:-1], name)}  # tanh follows here, too
    space = model.observation_space
    return Learnable(
        name,
        learns_by,
        networks,
        None if log_std is None else array_of(log_std),
        env_units=learns_by == "PPO",
        scaling=None if normalize is None else _moments(normalize, space),
        observation_space=space,
        action_space=model.action_space,
        settings=settings,
    )


def _moments(normalize: Any, space: Space[Any]) -> tuple[Array, Array, float]:
    """Return mean, variance and number of observations, by ``VecNormalize``."""
    rms: Any = getattr(normalize, "obs_rms", None)
    if isinstance(rms, dict) or not isinstance(space, Box):
        raise PolicyError(
            f"from_sb3(learn=True): normalize scales parts of {short(space, 200)}, and only "
            "observations of a Box can be scaled further"
        )
    return np.ravel(rms.mean), _variance(rms), float(rms.count)


def _variance(rms: Any) -> Array:
    """Return the variances in a ``VecNormalize``'s statistics; 1 of constants.

    It begins as if 1e-4 samples with mean 0 and variance 1 had been seen.
    """
    import torch

    from skillweave.ops.moments import is_constant

    mean, var = (torch.as_tensor(np.ravel(x), dtype=torch.float64) for x in (rms.mean, rms.var))
    made_up = 1e-4 * (1.0 + mean.square()) / rms.count
    known: Array = torch.where(is_constant(mean, (var - made_up).abs()), 1.0, var).numpy()
    return known


def _mapping(model: Any, normalize: Any, options: dict[str, Any]) -> PolicyMapping:
    """Return the mapping declared for a Stable-Baselines3 model, with ``VecNormalize`` in it."""
    if normalize is None:
        return mapping_of("from_sb3()", **options)
    space: Any = model.observation_space
    rms: Any = getattr(normalize, "obs_rms", None)
    by_name = dict(rms) if isinstance(rms, dict) else {"": rms}
    parts = dict(space.spaces) if isinstance(space, Dict) else {"": space}
    shapes = {name: np.shape(getattr(one, "mean", 0.0)) for name, one in by_name.items()}
    if any(name not in parts or parts[name].shape != shape for name, shape in shapes.items()):
        raise DeclarationError(
            f"normalize is {short(normalize)}; it must be the VecNormalize of the model, with "
            f"statistics of observations {space}; normalize=False takes none"
        )
    limit = float(normalize.clip_obs)
    scaling = {
        name: Scaling(
            offset=np.ravel(one.mean),
            scale=1.0 / np.sqrt(_variance(one) + normalize.epsilon),
            clip=(-limit, limit),
        )
        for name, one in by_name.items()
    }
    if scaling and options["sees"] is None:
        whole = {name: Part(name, one_hot=False) for name in parts}
        options = options | {"sees": whole.get("", whole)}
    return mapping_of("from_sb3()", **options, scaling=scaling)


def _opened(file: Path, trust: bool, model: Any) -> Any:
    """Return the ``VecNormalize`` in a file, for a model."""
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    if trust is not True:
        raise PolicyError(
            f"{file} was not opened: VecNormalize is saved as a pickle, which can run any code "
            "on your machine. If you trust its author, add trust=True"
        )
    # VecNormalize compares the spaces of its environment, and no more.
    spaces = {k: getattr(model, k) for k in ("observation_space", "action_space")}
    stub: Any = type("Stub", (Env,), spaces)
    check_file(file)
    try:
        return VecNormalize.load(str(file), DummyVecEnv([stub]))
    except (Exception, SystemExit) as error:
        raise PolicyError(
            f"{file} could not be opened as the VecNormalize of observations "
            f"{model.observation_space}: {error_text(error)}"
        ) from error


def _other_version(content: bytes, here: str) -> str:
    """Return the likely reason why a Stable-Baselines3 file did not open."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            saved = archive.read("_stable_baselines3_version").decode("ascii", "replace").strip()
    except (zipfile.BadZipFile, KeyError):
        return "It is no zip of Stable-Baselines3"
    if saved != here:
        return (
            f"It was saved by Stable-Baselines3 {shortened(saved, 40)}, and {here} is installed: "
            "install that version, or save it again by this one"
        )
    return "Did another algorithm save it?"
