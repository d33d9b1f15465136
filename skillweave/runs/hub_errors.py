"""Errors of the hub's library as sentences for users.

Stands alone because it translates another library's exceptions, which ``hub`` only wraps.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from skillweave.errors import RunError, SkillweaveError
from skillweave.messages import short, shortened


def status_of(error: BaseException | None) -> Any:
    """Return the status code of the hub's answer; None: it did not answer."""
    while error is not None:
        if (response := getattr(error, "response", None)) is not None:
            return response.status_code
        error = error.__cause__
    return None


@contextmanager
def asking(
    api: Any, name: str, *, writes: bool = False, revision: str | None = None
) -> Iterator[None]:
    """Convert errors of the hub's library within the block to a RunError."""
    try:
        yield
    except SkillweaveError:
        raise
    except Exception as error:  # of any of the libraries that it stands on
        raise RunError(_sentence(error, api.endpoint, name, writes, revision)) from error


def _sentence(
    error: Exception, endpoint: str, name: str, writes: bool, revision: str | None
) -> str:
    errors = importlib.import_module("huggingface_hub.errors")
    status = status_of(error)
    login = "log in (hf auth login), or set HF_TOKEN"
    if isinstance(error, errors.GatedRepoError):
        return f"{name} is gated: ask for access on {endpoint}/{name}, then {login}"
    if isinstance(error, errors.RevisionNotFoundError):
        return f"{name} has no revision {short(revision)}; look at {endpoint}/{name}/commits/main"
    if status == 401 and writes:
        return f"{endpoint} does not recognise you: {login} to a token that may write"
    if status == 403 and writes:
        return (
            f"you may not write to {name}: its owner must be you or an organisation of yours, and "
            "your token one that may write"
        )
    if status in (401, 403, 404) or isinstance(error, errors.RepositoryNotFoundError):
        return (
            f"{endpoint} has no {name}, or it is private and you may not read it. Check the name; "
            f"if it is private, {login}"
        )
    what = shortened(f"{type(error).__name__}: {error}".replace("\n", " "), 300)
    if status is not None:
        return f"{endpoint} refused {name} with the answer {status}; try again later. {what}"
    if isinstance(error, errors.HFValidationError) or type(error) is ValueError:  # no request
        return f"{name} is refused: {what}"
    after = "Nothing was pushed" if writes else f"This machine has no copy of {name}"
    return (
        f"{endpoint} cannot be reached. {after}. Check the network, HF_ENDPOINT and "
        f"HF_HUB_OFFLINE, then try again. {what}"
    )
