"""Tools of all rooms that no user sees: messages, checks of arguments, paths, seeds, signals.

Begin with ``messages``, which has the parts of sentences, and ``paths``, which names the parts of a
hierarchy.
"""
