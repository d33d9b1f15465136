"""Entry point: parse, call ``execute``, print, and turn errors into exit codes."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; 0 on success, 1 on an error, 2 on wrong arguments, 130 on Ctrl-C."""
    import tyro

    from skillweave.cli import commands

    words = sys.argv[1:] if arguments is None else arguments
    given = ["--no-deterministic" if word == "--stochastic" else word for word in words]
    parser: dict[str, Any] = {commands.name_of(c): c for c in commands.COMMANDS}
    command: Any = tyro.extras.subcommand_cli_from_dict(
        parser,
        prog="skillweave",
        description="Teach agents skills and weave them into one policy.",
        args=given,
    )
    from skillweave.types import SkillweaveError

    try:
        from skillweave.cli import execute

        return execute.run(command)
    except SkillweaveError as error:
        return _fail(command, str(error), 1)
    except KeyboardInterrupt as error:
        return _fail(command, str(error) or "interrupted", 130)
    except BrokenPipeError:
        return 1


def _fail(command: Any, message: str, code: int) -> int:
    if command.json:
        print(json.dumps({"error": message}))
    kind = "stopped" if code == 130 else "error"
    print(f"{kind}: {message}", file=sys.stderr)
    return code
