"""The command line: parse, call, print."""

from skillweave.cli.main import main

__all__ = ["main"]
