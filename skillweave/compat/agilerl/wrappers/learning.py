"""AgileRL's Skill."""

from typing import Any

import gymnasium as gym


class Skill(gym.Wrapper[Any, Any, Any, Any]):
    """An environment with a reward of the user's."""

    def step(self, action: Any) -> Any:
        """The environment's step, as ``skill_reward`` changes it."""
        return self.skill_reward(*self.env.step(action))

    def skill_reward(
        self, observation: Any, reward: Any, terminated: Any, truncated: Any, info: Any
    ) -> Any:
        """To be overridden: what the step returns; it may reset ``self.env``."""
        return observation, reward, terminated, truncated, info
