"""Entry point: parse, call ``execute``, print, and turn errors into exit codes."""

from __future__ import annotations

import json
import re
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from skillweave._internal.terminal import end_quietly, put_result, say, steady_streams

ADDRESS = re.compile(r"auto|local|(ray://)?[^\s/-][^\s/]*:\S*")
"""What may follow ``--ray``."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; 0 on success, 1 on an error, 2 on wrong arguments, 130 on Ctrl-C.

    A reader that went away (``| head``) is no error.
    """
    try:
        with steady_streams():
            return _main(arguments)
    except BrokenPipeError:
        return 0
    finally:
        end_quietly()


def _main(arguments: Sequence[str] | None) -> int:
    words = sys.argv[1:] if arguments is None else arguments
    if list(words) == ["--version"]:
        from skillweave import __version__

        put_result(f"skillweave {__version__}")
        return 0
    import tyro

    from skillweave.cli import commands

    tyro_arguments = ["--no-deterministic" if word == "--stochastic" else word for word in words]
    tyro_arguments = _with_addresses(tyro_arguments)
    parser: dict[str, Any] = {commands.name_of(c): c for c in commands.COMMANDS}
    if wrong := _unknown_command(words, list(parser)):
        say(f"error: {wrong}")
        return 2
    command: Any = tyro.extras.subcommand_cli_from_dict(
        parser,
        prog="skillweave",
        description="Teach agents skills and weave them into one policy. "
        "skillweave --version prints the version.",
        args=tyro_arguments,
    )
    from skillweave._internal.tracebacks import all_frames_wanted
    from skillweave.errors import SkillweaveError
    from skillweave.runs.command_words import called_by

    try:
        from skillweave.cli import execute

        with called_by("command line"):
            return execute.run(command)
    except SkillweaveError as error:
        if command.traceback or all_frames_wanted():
            say("".join(traceback.format_exception(error)).rstrip())
        return _fail(command, str(error), 1)
    except KeyboardInterrupt as error:
        return _fail(command, str(error) or "interrupted", 130)


def _unknown_command(words: Sequence[str], known: Sequence[str]) -> str:
    """Return a sentence about a first word that is no command; empty if it is one, or none."""
    if not words or words[0] in known or words[0].startswith("-"):
        return ""
    from skillweave._internal.messages import suggest

    return f"no command {words[0]!r}{suggest(words[0], known)} (skillweave --help)"


def _with_addresses(words: Sequence[str]) -> list[str]:
    """Return the words with an empty address after each ``--ray`` that has none."""
    complete: list[str] = []
    for word in words:
        if complete[-1:] == ["--ray"] and not ADDRESS.fullmatch(word):
            complete.append("")
        complete.append(word)
    return [*complete, ""] if complete[-1:] == ["--ray"] else complete


def _fail(command: Any, message: str, code: int) -> int:
    if command.json:
        with suppress(OSError):  # it is printed below as well
            put_result(json.dumps({"error": message}))
    kind = "stopped" if code == 130 else "error"
    say(f"{kind}: {message}")
    return code
