"""Output for people: progress, films, figures, and the report of a run in ``report``.

Begin with ``report/single``; ``report/facts`` has the facts that all of them print.
"""
