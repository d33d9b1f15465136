"""Parts of sentences for people: values, errors and numbers in messages."""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType

from skillweave._internal.tracebacks import place
from skillweave.errors import DeclarationError, RunError

STARTS = (
    "episodes start where the environment's reset() puts them; to start elsewhere, give a wrapper "
    "whose reset() passes on options or sets the state, EnvSpec(env, wrappers=(Elsewhere,)): the "
    "documentation has its lines, under 'A curriculum', 'Start episodes elsewhere'"
)
RECORDINGS = (
    "Skillweave does not learn from demonstrations or other recorded data; learn a policy from "
    "them with another library, and start from it: train(start_from=from_torch(policy, "
    "learn=True)), or from_sb3"
)
ELSEWHERE = {
    "can_start": "initiation",
    "clip_param": "clip_coef",
    "clip_range": "clip_coef",
    "compute_reward": "reward",
    "demonstrations": RECORDINGS,
    "discount": "gamma",
    "done": "termination",
    "env_id": "env",
    "env_kwargs": "kwargs",
    "eval_freq": "eval_every",
    "hidden_sizes": "hidden",
    "initial_state": STARTS,
    "is_success": "success",
    "lr": "learning_rate",
    "max_episode_steps": "max_steps",
    "minibatch_size": "batch_size",
    "n_envs": "num_envs",
    "n_epochs": "update_epochs",
    "n_eval_episodes": "episodes",
    "net_arch": "hidden",
    "num_epochs": "update_epochs",
    "num_steps": "n_steps",
    "options": "skills",
    "predict": "policy",
    "reset_options": STARTS,
    "rest": "Hierarchy.rest",
    "reward_fn": "reward",
    "terminated": "termination",
    "time_limit": "max_steps",
    "total_timesteps": "steps",
}
"""Names that users of other libraries type, of settings and of a skill's attributes, with the names
here, or with a sentence on what to do instead. At most 30: similar names are found without it."""
RENAMED = {"call_cost": "deliberation_cost"}
"""Earlier names of settings, with those of now."""


def short(value: object, longest: int = 100) -> str:
    """Return ``repr(value)`` for a message, its middle left out where it is long."""
    try:
        text = repr(value)
    except Exception:
        text = f"a {type(value).__name__}"
    return shortened(text, longest)


def shortened(text: str, longest: int = 500) -> str:
    """Return text for a message, its middle left out where it is long."""
    half = longest // 2
    return text if len(text) <= longest else f"{text[:half]} ... {text[-half:]}"


def aligned(rows: Sequence[Sequence[str]], left: int = 0) -> str:
    """Return a table, a line for each row.

    Args:
        rows: cells of text, equally many in each.
        left: the number of columns that are aligned left; the others are aligned right.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    pads = (str.ljust,) * left + (str.rjust,) * (len(widths) - left)
    lines = ("  ".join(p(c, w) for p, c, w in zip(pads, row, widths, strict=True)) for row in rows)
    return "\n".join(lines)


def suggest(
    name: object,
    known: Iterable[str],
    elsewhere: Mapping[str, str] = MappingProxyType({}),
    *,
    least: float = 0.6,
    listed: bool = True,
) -> str:
    """Return the end of a sentence about an unknown name: the known one that is probably meant.

    Args:
        name: the name that was written.
        known: the names that exist there.
        elsewhere: by the names that exist at other places, where: "a setting of apart: …".
        least: the similarity that a name must have, from 0 to 1, as ``difflib``'s ratio.
        listed: name all that are known where none is similar.

    Returns:
        A text that begins with a colon or a semicolon, or nothing.
    """
    here = list(known)
    places = {**elsewhere, **dict.fromkeys(here, "")}
    spelled = {p.lower().replace("-", "_"): p for p in places}
    wanted = str(name).lower().replace("-", "_")
    similar = difflib.get_close_matches(wanted, spelled, 1, least)
    for spelling in (wanted, (ELSEWHERE | RENAMED).get(wanted, ""), *similar):
        if near := spelled.get(spelling):
            where = f"it is {places[near]}" if places[near] else ""
            if near == name:
                return f"; {where}"
            return f": is {near!r} meant?{where and f' I{where[1:]}'}"
    return f"; there are: {', '.join(here)}" if here and listed else ""


def error_text(error: BaseException) -> str:
    """Return an error of the user's code for a sentence: its kind, message, file and line."""
    try:
        message = str(error)
    except Exception:
        message = ""
    text = type(error).__name__ + (f": {shortened(message)}" if message else "")
    where = place(error)
    return f"{text.removesuffix('.')} ({where})" if where else text


def absolute(path: str | Path) -> Path:
    """Return the path from the root on, for messages and files: it is the same everywhere.

    Raises:
        RunError: the working directory, from which it leads, was deleted.
    """
    try:
        return Path(path).absolute()
    except OSError as error:
        raise RunError(
            f"{path} leads from the working directory, and that is not there any more: change to "
            "another directory, or give the path from the root on"
        ) from error


def shown_path(path: Path) -> Path:
    """Return a path for messages: from the working directory on where it is below that."""
    with suppress(OSError, ValueError):
        return path.relative_to(Path.cwd()) if path.is_absolute() else path
    return path


def as_path(path: str | Path, name: str) -> Path:
    """Return ``path`` as a ``Path``; an error names the argument where it cannot be one.

    Raises:
        DeclarationError: it is no path.
        RunError: the system cannot look there, because a name is too long, for example.
    """
    if not isinstance(path, str | Path) or "\0" in str(path) or len(str(path)) > 4_096:
        raise DeclarationError(f"{name} is {short(path)}; it must be a path")
    try:
        os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:
        raise RunError(f"{name} is {short(str(path))}: {error.strerror}") from error
    return Path(path)
