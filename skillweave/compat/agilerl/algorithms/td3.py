"""AgileRL's TD3."""

from skillweave.compat.agilerl.agents import TD3 as TD3
