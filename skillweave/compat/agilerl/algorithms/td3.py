"""AgileRL's TD3."""

from skillweave.compat.agilerl.agent_classes import TD3 as TD3
