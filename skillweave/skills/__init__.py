"""Skills and reflexes: what a user declares."""

from skillweave.skills.base import Reflex, Skill, apply_reflexes, checked

__all__ = ["Reflex", "Skill", "apply_reflexes", "checked"]
