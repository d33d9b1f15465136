"""Entry point: parse, call ``execute``, print, and turn errors into exit codes."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from typing import Any

from skillweave._internal.terminal import (
    end_quietly,
    put_line,
    put_result,
    reserved_stdout,
    say,
    steady_streams,
)
from skillweave.policies.acting_errors import RunError

Put = Callable[[str], None]
"""A function that writes a command's result."""
ADDRESS = re.compile(r"auto|local|(ray://)?[^\s/-][^\s/]*:\S*")
"""Addresses of a cluster that may follow ``--ray``."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; 0 on success, 1 on an error, 2 on wrong arguments, 130 on Ctrl-C.

    A reader that went away (``| head``) is no error.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    alone = arguments is None  # this process is for the command
    try:
        with steady_streams():
            if "--json" not in words or {"-h", "--help"} & set(words):
                return _main(words, put_result, alone)
            with reserved_stdout(lasting=alone) as stream:
                return _with_json(words, stream, alone)
    except BrokenPipeError:
        return 0
    finally:
        end_quietly()


def _with_json(words: Sequence[str], stream: Any, alone: bool) -> int:
    """Run one command, and write one JSON object to ``stream``, however the command ends."""
    answered = False

    def put(text: str) -> None:
        nonlocal answered
        answered = True
        put_line(text, stream)

    try:
        return _main(words, put, alone)
    except BaseException as error:
        if not answered:
            wrong = isinstance(error, SystemExit)
            message = "the arguments are wrong; standard error says how" if wrong else repr(error)
            with suppress(RunError):  # the error itself goes on
                put(as_json({"error": message}))
        raise


def _main(words: Sequence[str], put: Put, alone: bool) -> int:
    """Parse the words of a command line, carry out the command, return its exit code."""
    if list(words) == ["--version"]:
        from skillweave import __version__

        put(f"skillweave {__version__}")
        return 0
    command: Any = None
    try:
        with _short_interrupts(words, put) if alone else nullcontext():
            import tyro

            from skillweave._internal.tracebacks import all_frames_wanted
            from skillweave.cli import commands
            from skillweave.cli.elsewhere import foreign_words
            from skillweave.errors import SkillweaveError

            parser: dict[str, Any] = {k: kind for k, (kind, _) in commands.all_commands().items()}
            if missing := commands.missing(words):
                return _fail(words, put, missing, 1)
            if wrong := foreign_words(words, parser):
                return _fail(words, put, wrong, 2)
            command = tyro.extras.subcommand_cli_from_dict(
                parser,
                prog="skillweave",
                description="Teach agents skills and weave them into one policy. "
                "skillweave --version prints the version.",
                args=_for_tyro(words),
            )
            from skillweave.cli import execute
            from skillweave.runs.command_words import called_by
    except KeyboardInterrupt:
        return _fail(words, put, "interrupted", 130)
    try:
        with called_by("command line"):
            result, text = execute.run(command)
            if command.json:
                put(as_json(result))
            elif text is not None:
                put(text)
        return 1 if result.get("failed") else 0  # runs of a sweep
    except SkillweaveError as error:
        if command.traceback or all_frames_wanted():
            say("".join(traceback.format_exception(error)).rstrip())
        return _fail(words, put, str(error), 1)
    except KeyboardInterrupt as error:
        return _fail(words, put, str(error) or "interrupted", 130)


@contextmanager
def _short_interrupts(words: Sequence[str], put: Put) -> Iterator[None]:
    """End the command at Ctrl-C within the block, in which large libraries are imported.

    An exception in the middle of an import may be lost, or become another one.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return

    def end(*_: Any) -> None:
        try:
            _fail(words, put, "interrupted", 130)
        finally:
            os._exit(130)

    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _for_tyro(words: Sequence[str]) -> list[str]:
    return _with_addresses(["--no-deterministic" if w == "--stochastic" else w for w in words])


def _with_addresses(words: Sequence[str]) -> list[str]:
    """Return the words with an empty address after each ``--ray`` that has none."""
    complete: list[str] = []
    for word in words:
        if complete[-1:] == ["--ray"] and not ADDRESS.fullmatch(word):
            complete.append("")
        complete.append(word)
    return [*complete, ""] if complete[-1:] == ["--ray"] else complete


def _fail(words: Sequence[str], put: Put, message: str, code: int) -> int:
    """Print the error of a command, as JSON too if it is wanted; return the exit code."""
    if "--json" in words:
        with suppress(RunError):  # it is printed below as well
            put(as_json({"error": message}))
    kind = "stopped" if code == 130 else "error"
    say(f"{kind}: {message}")
    return code


def as_json(result: dict[str, Any]) -> str:
    """Return a command's result as JSON that is safe for terminals; NaN becomes null."""
    try:
        text = json.dumps(result, default=str, allow_nan=False)
    except ValueError:
        text = json.dumps(_finite(json.loads(json.dumps(result, default=str))))
    return text.replace("\x7f", "\\u007f")


def _finite(data: Any) -> Any:
    """Return data of a command's JSON in which NaN and infinity are None."""
    if isinstance(data, dict):
        return {key: _finite(value) for key, value in data.items()}
    if isinstance(data, list):
        return [_finite(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data
