"""AgileRL's DQN."""

from skillweave.compat.agilerl.agents import DQN as DQN
