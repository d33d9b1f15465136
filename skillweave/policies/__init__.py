"""Policies that act in N environments at once; NumPy alone, as exports are made of them.

Begin with ``core``, the interface of all; ``hierarchy`` has the life of a call. ``parts`` stand
around another policy, as reflexes do, and ``spaces`` describes what policies see and return.
"""
