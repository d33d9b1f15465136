"""Policies that act in N environments at once; NumPy alone, as exports are made of them.

Begin with ``core``, the interface of all; ``hierarchy`` has the life of a call.
"""
