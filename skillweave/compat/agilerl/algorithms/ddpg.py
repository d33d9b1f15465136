"""AgileRL's DDPG."""

from skillweave.compat.agilerl.agents import DDPG as DDPG
