"""AgileRL's Skill."""

from typing import Any

import gymnasium as gym


class Skill(gym.Wrapper[Any, Any, Any, Any]):
    """An environment with a reward of the user's."""

    def step(self, action: Any) -> Any:
        """Return the environment's step, as ``skill_reward`` changes it."""
        return self.skill_reward(*self.env.step(action))

    def skill_reward(
        self, observation: Any, reward: Any, terminated: Any, truncated: Any, info: Any
    ) -> Any:
        """Return the step's result; override it, and reset ``self.env`` in it if needed."""
        return observation, reward, terminated, truncated, info
