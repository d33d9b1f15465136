"""From environments to rows: policies act, steps are recorded, and each learner gets its rows.

Begin with ``collector``, which steps and records; ``learners`` and ``views`` make rows of it.
"""
