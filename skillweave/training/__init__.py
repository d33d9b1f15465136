"""The loops, phases, and evaluation."""
