"""Training: the stages of a run, the loop of each, and evaluation.

Begin with ``loop``, which trains everything; ``trainer`` runs a stage, and ``evaluation`` plays
whole episodes.
"""
