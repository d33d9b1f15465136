"""AgileRL's environments and populations."""

import inspect
from typing import Any

from gymnasium.vector import AutoresetMode, SyncVectorEnv

from skillweave._internal.messages import suggest
from skillweave.compat.agilerl.agent_classes import KINDS
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError


def makeVectEnvs(env_name: str, num_envs: int = 1) -> SyncVectorEnv:
    """Make environments in this process; each restarts in the step that ends its episode."""
    return _vector(EnvSpec(env_name), num_envs)


def makeSkillVectEnvs(env_name: str, skill: Any, num_envs: int = 1) -> SyncVectorEnv:
    """Return ``makeVectEnvs`` with a ``Skill`` around each environment."""
    return _vector(EnvSpec(env_name, wrappers=(skill,)), num_envs)


def _vector(spec: EnvSpec, num_envs: int) -> SyncVectorEnv:
    # As Gymnasium did when these scripts were written: no step is lost to a reset.
    return SyncVectorEnv([spec.make] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)


def initialPopulation(
    algo: str,
    state_dim: Any,
    action_dim: int,
    one_hot: bool,
    net_config: dict[str, Any],
    INIT_HP: dict[str, Any],
    actor_network: Any = None,
    critic_network: Any = None,
    population_size: int = 1,
    device: Any = "cpu",
    accelerator: Any = None,
) -> list[Any]:
    """Make agents of one kind; settings by their names in capitals from ``INIT_HP``.

    Raises:
        DeclarationError: no such algorithm, or a setting without a default is missing.
    """
    given = locals() | {"critic_networks": critic_network}
    if algo not in KINDS:
        raise DeclarationError(f"no algorithm {algo!r} here{suggest(algo, KINDS)}")
    known = inspect.signature(KINDS[algo]).parameters
    settings = {k: INIT_HP[k.upper()] for k in known if k.upper() in INIT_HP}
    settings |= {k: v for k, v in given.items() if k in known}
    missing = [k.upper() for k, p in known.items() if p.default is p.empty and k not in settings]
    if missing:
        raise DeclarationError(f"INIT_HP has no {', '.join(missing)}, which {algo} needs")
    return [KINDS[algo](**settings | {"index": i}) for i in range(population_size)]


make_vect_envs = makeVectEnvs
make_skill_vect_envs = makeSkillVectEnvs
create_population = initialPopulation
