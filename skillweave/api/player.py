"""A policy in one environment, an observation at a time: for deployment."""

from __future__ import annotations

from typing import Any, Literal

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave._internal.policy_protocol import Policy
from skillweave.errors import DeclarationError
from skillweave.hierarchy.policy import SkillAlone
from skillweave.policies.actor import ROW, Actor, Deployed
from skillweave.policies.core import Array
from skillweave.policies.spaces import space_of
from skillweave.skills.skill_set import in_place
from skillweave.spaces import obs_dtype


@checked_names
class Player(Actor):
    """A policy that acts in one environment and keeps its memory.

    ```python
    import gymnasium as gym
    import skillweave as sw

    env = gym.make("CartPole-v1")
    policy = sw.from_function(
        lambda obs: (obs[:, 2] > 0).astype(int),
        observation_space=env.observation_space,
        action_space=env.action_space,
    )
    player = sw.Player(policy)  # of a run: run.player()
    obs, info = env.reset(seed=0)
    player.reset()
    ended = False
    while not ended:
        obs, reward, terminated, truncated, info = env.step(player.act(obs))
        ended = terminated or truncated
    ```

    Args:
        policy: the policy that acts.
        deterministic: act greedily, else sample.
        seed: the seed of sampled actions.
        nan: what a NaN in an observation is: an error, or a zero.
        goal: of a skill with goals that acts alone (``run.player(skill="go_to", goal=...)``), until
            ``reset`` sets another; None: its ``goals()`` draw one in each episode.

    Raises:
        DeclarationError: a goal is given to a policy that takes none.
        EnvError: the policy observes an unsupported space.
        SkillError: the goal is out of the skill's ``goal_space``.
    """

    def __init__(
        self,
        policy: Policy,
        *,
        deterministic: bool = True,
        seed: int = 0,
        goal: Any = None,
        nan: Literal["error", "zero"] = "error",
    ) -> None:
        self.policy = self._with_goal(policy, goal)
        obs_dtype(policy.observation_space)
        spaces = map(space_of, (policy.observation_space, policy.action_space))
        deployed = Deployed(in_place(policy), *spaces)
        super().__init__(deployed, deterministic=deterministic, seed=seed, nan=nan)

    def reset(self, *, goal: Any = None) -> None:
        """Start a new episode with an empty memory.

        Args:
            goal: as of ``Player``; None: as before.

        Raises:
            DeclarationError: a goal is given to a policy that takes none.
            SkillError: the goal is out of the skill's ``goal_space``; the goal before stays.
        """
        self.policy = self._with_goal(self.policy, goal)
        super().reset()

    def _begin(self, seen: Array) -> None:
        """Set the goal of a new episode, if a skill with goals acts alone."""
        if isinstance(self.policy, SkillAlone):
            self.policy.choose_goals(self.memory, ROW, seen, [self._world.rng])

    def _with_goal(self, policy: Policy, goal: Any) -> Policy:
        """Return the player's policy with one goal in all episodes; None: as it is."""
        if goal is None:
            return policy
        if isinstance(policy, SkillAlone):
            return policy.with_goal(goal, "the player")
        raise DeclarationError(
            f"the goal {short(goal)} is given to a policy that takes none: name a skill with "
            'goals, run.player(skill="go_to", goal=...)'
        )
