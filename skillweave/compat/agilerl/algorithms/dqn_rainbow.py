"""AgileRL's RainbowDQN."""

from skillweave.compat.agilerl.agents import RainbowDQN as RainbowDQN
