"""Stores of experience until an algorithm learns from it.

Begin with ``rollout``, for algorithms that learn from the latest rows; ``replay`` samples from all
that are kept.
"""
