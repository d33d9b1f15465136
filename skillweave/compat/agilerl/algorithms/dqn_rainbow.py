"""AgileRL's RainbowDQN."""

from skillweave.compat.agilerl.agent_classes import RainbowDQN as RainbowDQN
