"""The run directory: what training writes and everything else reads.

Begin with ``directory``, its files; ``manifest`` has the schemas of what is in them.
"""
