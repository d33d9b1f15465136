"""Repair of a handover: a skill learns on from where another one ends, and the better one is kept.

Begin with ``repairing``, the course of ``Run.repair``; ``repair_stage`` is the stage that it adds.
"""
