"""Environments: engines with one meaning of resets, and checks of environments."""
