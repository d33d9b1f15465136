"""The loops, stages, and evaluation."""
