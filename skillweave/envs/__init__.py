"""Environments: engines with one auto-reset meaning, and a skill's view of them."""
