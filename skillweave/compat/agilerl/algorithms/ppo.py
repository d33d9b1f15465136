"""AgileRL's PPO."""

from skillweave.compat.agilerl.agents import PPO as PPO
