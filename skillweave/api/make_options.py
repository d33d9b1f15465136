"""An environment whose actions are a hierarchy's skills, for selectors of other libraries."""

from __future__ import annotations

from skillweave._internal.arguments import checked_names
from skillweave._internal.seeding import Seeds, global_generators
from skillweave.api import Hierarchy, Run, TrainedPolicy
from skillweave.envs.make import make_engine
from skillweave.errors import DeclarationError
from skillweave.hierarchy.fitting import ready_policies
from skillweave.hierarchy.options_env import OptionsEnv
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.hierarchy.roles import roles_of
from skillweave.schema import AtLeastOne, Share, fitted


@checked_names
def make_options_env(
    hierarchy: Hierarchy | Run, num_envs: int, gamma: float, *, seed: int = 0
) -> OptionsEnv:
    """Return a Gymnasium ``VectorEnv`` of ``num_envs`` environments; each action is a call.

    Args:
        hierarchy: a run of one, whose trained skills act; or a declaration whose skills all have a
            ready policy.
        num_envs: environments side by side.
        gamma: γ of one environment step, over 0 and at most 1.
        seed: of skills that sample, and of environments that draw when they are made.

    Returns:
        ``OptionsEnv``; its ``skills`` go into ``HierarchyPolicy`` with the selector once trained.

    Raises:
        DeclarationError: a skill has no policy; the message names it.
    """
    num_envs = fitted(AtLeastOne, num_envs, "num_envs")
    gamma = fitted(Share, gamma, "gamma")
    if isinstance(hierarchy, TrainedPolicy):
        if not isinstance(hierarchy.policy, HierarchyPolicy):
            raise DeclarationError("this is the run of a plain agent: it has no skills to call")
        skills, spec = hierarchy.policy.skills, hierarchy.hierarchy.spec
    else:
        roles = roles_of(hierarchy)
        ready = ready_policies(roles)
        spec = roles.spec
        lacking = [path for path in roles.outermost.skills if path not in ready]
        if lacking:
            raise DeclarationError(
                f"skill {lacking[0]!r} has no policy: train the hierarchy and give its run, or "
                "declare the skill with a policy"
            )
        skills = roles.outermost.skill_set(ready)
    with global_generators(Seeds(seed) / "options"):
        engine = make_engine(spec, num_envs)
    return OptionsEnv(engine, skills, float(gamma), seed)
