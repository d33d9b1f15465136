"""Collectors elsewhere: in processes of this machine, or on other machines by Ray.

Begin with ``host``, what all of them are asked and how lost ones are made again; ``placement``
chooses where they run.
"""
