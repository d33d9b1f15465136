"""AgileRL's DQN."""

from skillweave.compat.agilerl.agent_classes import DQN as DQN
