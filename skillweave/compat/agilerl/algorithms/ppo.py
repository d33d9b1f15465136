"""AgileRL's PPO."""

from skillweave.compat.agilerl.agent_classes import PPO as PPO
