"""The command line: parse, call, print.

Begin with ``commands``, which lists commands and their options; ``execute`` carries them out.
"""

from skillweave.cli.main import main

__all__ = ["main"]
