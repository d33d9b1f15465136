"""Settings of every algorithm: frozen dataclasses, one string under each field.

The command line, the run's JSON and the documentation are generated from these. This module
does not import torch, so that ``--help`` and argument errors are instant.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
from typing import Annotated, Any, TypeAlias

import gymnasium as gym

from skillweave.algorithms.config_off_policy import DQN, SAC, TD3, OffPolicy
from skillweave.algorithms.config_on_policy import PPO, OnPolicy, SelfImitationPPO, SkillCritic
from skillweave.errors import DeclarationError, RunError
from skillweave.named import Named
from skillweave.reading import as_json, fit, shown
from skillweave.settings import Check

AlgorithmConfig: TypeAlias = OnPolicy | OffPolicy
"""Any algorithm's settings, those of users' own algorithms included."""
AlgorithmSettings: TypeAlias = Annotated[
    AlgorithmConfig, Check("the settings of an algorithm, such as PPO()")
]
"""An algorithm's settings as a field of other settings."""


@dataclass(frozen=True)
class Registration:
    """An algorithm, registered under the name of its settings."""

    config: type[Any]
    """The dataclass of its settings."""
    algorithm: Any
    """Its class, or the path of its class, ``module:class``."""
    action_spaces: tuple[type[gym.Space[Any]], ...]
    """The kinds of action spaces that the algorithm supports."""
    acts: bool = True
    """True if the algorithm can be chosen to act; False if it only serves others."""


_SPACES, _HOME = gym.spaces, "skillweave.algorithms"
_ANY = (_SPACES.Discrete, _SPACES.MultiDiscrete, _SPACES.MultiBinary, _SPACES.Box)
_REGISTERED: dict[str, Registration] = {
    "PPO": Registration(PPO, f"{_HOME}.ppo:PPOAlgorithm", _ANY),
    "SelfImitationPPO": Registration(
        SelfImitationPPO, f"{_HOME}.self_imitation:SelfImitationAlgorithm", _ANY
    ),
    "SkillCritic": Registration(
        SkillCritic, f"{_HOME}.skill_critic:SkillCriticAlgorithm", (_SPACES.Discrete,), acts=False
    ),
    "DQN": Registration(DQN, f"{_HOME}.dqn:DQNAlgorithm", (_SPACES.Discrete,)),
    "TD3": Registration(TD3, f"{_HOME}.td3:TD3Algorithm", (_SPACES.Box,)),
    "SAC": Registration(SAC, f"{_HOME}.sac:SACAlgorithm", (_SPACES.Box, _SPACES.Discrete)),
}
BUILT_IN = tuple(_REGISTERED)
"""Names of the algorithms of this library."""


def add_registration(registration: Registration) -> None:
    """Register an algorithm, in place of an earlier one; see ``registry.register_algorithm``."""
    _REGISTERED[registration.config.__name__] = registration


def own_registrations() -> list[Registration]:
    """Return the algorithms that are not of this library."""
    return [r for name, r in _REGISTERED.items() if name not in BUILT_IN]


def registration_of(config: Any) -> Registration:
    """Return the algorithm that settings belong to.

    Raises:
        DeclarationError: the algorithm was never registered.
    """
    kind = type(config)
    for registration in _REGISTERED.values():
        if registration.config is kind:
            return registration
    raise DeclarationError(_not_registered(kind.__name__))


def _not_registered(name: str) -> str:
    return (
        f"no algorithm is registered for {name}; there are: {', '.join(_REGISTERED)}. An algorithm "
        "of your own must be registered in every process that uses it, before it is used: call "
        "skillweave.register_algorithm(its settings, its class) in the file that defines it, and "
        "import that file in your program or recipe"
    )


def check_spaces(config: Any, action_space: gym.Space[Any], where: str = "") -> None:
    """Raise a DeclarationError that names other algorithms if this one cannot act in a space."""
    if not isinstance(action_space, registration_of(config).action_spaces):
        able = [k for k, r in _REGISTERED.items() if r.acts]
        able = [k for k in able if isinstance(action_space, _REGISTERED[k].action_spaces)]
        raise DeclarationError(
            f"{where}{type(config).__name__} cannot act in {action_space}; "
            + (f"{', '.join(able)} can" if able else "no algorithm here can")
        )


def named_config(name: str, where: str) -> AlgorithmConfig:
    """Return an algorithm's or a preset's default settings by name, in any case.

    Raises:
        DeclarationError: no algorithm has this name; the message, which begins with ``where``,
            lists them.
    """
    kinds = {name: r.config for name, r in _REGISTERED.items() if r.acts}
    presets: dict[str, Any] = {**kinds, "Rainbow": DQN.rainbow, "DDPG": TD3.ddpg}
    for known, make in presets.items():
        if known.lower() == name.lower():
            config: AlgorithmConfig = make()
            return config
    raise DeclarationError(f"{where}: no algorithm {name!r}; there are: {', '.join(presets)}")


def config_to_json(config: AlgorithmConfig) -> dict[str, Any]:
    """Convert settings to plain JSON, with the algorithm's name under ``algorithm``.

    Raises:
        DeclarationError: a setting, of a user's own algorithm, cannot be recorded.
    """
    name = type(config).__name__
    return {"algorithm": name, **_settings(config, name)}


def _settings(value: Any, where: str) -> Any:
    """Convert settings to dicts; functions of the user become their recorded names.

    Raises:
        DeclarationError: a setting, of a user's own algorithm, cannot be recorded.
    """
    if is_dataclass(value):
        return {
            f.name: _settings(getattr(value, f.name), f"{where}.{f.name}") for f in fields(value)
        }
    if isinstance(value, Named):
        return str(value)
    return as_json(value, where, "record a name, and let the algorithm look up what it means")


def own_encoders(config: Any) -> list[str]:
    """Return the functions of the user that settings need for acting, by name."""
    networks = (getattr(config, name, None) for name in ("network", "critic"))
    return [n.encoder for n in networks if n is not None and isinstance(n.encoder, Named)]


def config_from_json(data: Any, file: str = "", path: str = "") -> AlgorithmConfig:
    """Read settings from the JSON of ``config_to_json``.

    Args:
        file: the file it was read from, for messages.
        path: the field in it: ``stages[0].algorithm``.

    Raises:
        RunError: an unknown algorithm or field, named, or a value of another type or out
            of range.
    """
    values: dict[str, Any] = fit(dict[str, Any], data, file, path)
    kind = values.pop("algorithm", None)
    if not isinstance(kind, str) or kind not in _REGISTERED:
        where = f"{file}: {path}: " if file else ""
        raise RunError(f"{where}{_not_registered(shown(kind))}")
    config: AlgorithmConfig = fit(_REGISTERED[kind].config, values, file, path or kind)
    return config


__all__ = [
    "DQN",
    "PPO",
    "SAC",
    "TD3",
    "AlgorithmConfig",
    "OffPolicy",
    "OnPolicy",
    "SelfImitationPPO",
    "SkillCritic",
]
