"""AgileRL's DDPG."""

from skillweave.compat.agilerl.agent_classes import DDPG as DDPG
