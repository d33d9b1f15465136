"""Policies made elsewhere: how they are fitted to an environment and recorded in a run."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Callable
from typing import Any, NotRequired, Self, TypedDict

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Dict, Tuple
from gymnasium.vector.utils import batch_space

from skillweave.errors import PolicyError, RunError, SkillweaveError
from skillweave.messages import short, told
from skillweave.types import Array, Memory, Memoryless, Policy


class Foreign(Memoryless):
    """A policy made elsewhere; its spaces may stay open until ``bind`` gives it an environment's.

    A run records its ``source``. If it has ``content``, the run keeps a copy, and the copy acts
    when the run is loaded. Without content, it must still have the same checksum then.
    """

    kind: str
    """The name of its kind in ``run.json``."""
    suffix: str = ""
    """The suffix of the file of its ``content``."""

    def __init__(self, name: str, observation_space: Any = None, action_space: Any = None) -> None:
        self.name = self._who = name
        self.observation_space, self.action_space = observation_space, action_space
        self._open = observation_space is None, action_space is None

    def bind(self, observation_space: Space[Any], action_space: Space[Any], who: str) -> Self:
        """Return a copy on ``observation_space`` and ``action_space``, where it has none of its own.

        Messages begin with ``who``.
        """
        bound = copy.copy(self)
        bound._who = f"{who}: {self.name}"
        if self._open[0]:
            bound.observation_space = observation_space
        if self._open[1]:
            bound.action_space = action_space
        return bound

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:
        """Actions for a batch of observations."""
        raise NotImplementedError

    def must_be_bound(self) -> None:
        """Raise a PolicyError if it has no spaces yet."""
        if self.action_space is None:
            raise PolicyError(f"{self._who} has no spaces yet: bind() it to an environment's")

    def source(self) -> dict[str, Any]:
        """Where it comes from, as JSON for ``run.json``: at least its kind."""
        content = self.content()
        sha256 = {} if content is None else {"sha256": checksum(content)}
        return {"kind": self.kind, "name": self.name, **sha256}

    def content(self) -> bytes | None:
        """Return the bytes that a run keeps a copy of; None: the run only names it."""
        return None

    def restored(self, content: bytes) -> Self:
        """This policy with the ``content`` from a run."""
        raise NotImplementedError

    def try_out(self) -> None:
        """Act once on two made-up observations, so that errors are found before training.

        Raises:
            PolicyError: it failed; the message names who, and the space.
        """
        try:
            self.act(self.start(2), made_up(self.observation_space, 2))
        except SkillweaveError:
            raise
        except (Exception, SystemExit) as error:
            space = short(self.observation_space, 300)
            raise PolicyError(
                f"{self._who} fails on observations of {space}: {told(error)}"
            ) from error


def fitted(
    policy: Policy, observation_space: Space[Any], action_space: Space[Any], who: str, env: str
) -> Policy:
    """Return the policy, ready to act on the spaces of the environment named ``env``.

    Raises:
        PolicyError: it does not fit; the message names ``who`` and both spaces.
    """
    from skillweave.spaces import same_space  # needs torch, which declaring a skill does not

    if isinstance(policy, Foreign):
        policy = policy.bind(observation_space, action_space, who)
    for kind, mine, theirs in (
        ("observation_space", policy.observation_space, observation_space),
        ("action_space", policy.action_space, action_space),
    ):
        if not same_space(mine, theirs):
            raise PolicyError(
                f"{who}: its policy has {kind} {mine}, but the environment {env} has {theirs}"
            )
    if isinstance(policy, Foreign):
        policy.try_out()
    return policy


class Source(TypedDict):
    """Where a ready policy comes from, as JSON."""

    kind: str
    name: NotRequired[str]
    file: NotRequired[str]
    sha256: NotRequired[str]
    """Of what it acts by, where there is a way to tell."""


def source_of(policy: Policy) -> dict[str, Any]:
    """Where a ready policy comes from, as JSON; see ``Source``.

    A policy may have a method ``source`` that says so, with a checksum of all that it acts by;
    of others the class is named.
    """
    own = getattr(policy, "source", None)
    found: dict[str, Any] = own() if callable(own) else {}
    return {"kind": "policy", "name": qualified(type(policy))} | found


def as_recorded(
    policy: Policy,
    recorded: dict[str, Any] | None,
    read: Callable[[], bytes | None],
    where: str,
) -> Policy:
    """Return the policy as it was when ``recorded`` was its source; ``read`` gets the copy kept then.

    Raises:
        RunError: it is of another kind, or another file that was only named; or the copy is
            damaged, or fits no longer.
    """
    if recorded is None:  # written before sources were
        return policy
    now = source_of(policy)
    if now["kind"] != recorded["kind"]:
        raise RunError(
            f"{where} had a policy of kind {_described(recorded)}, but now it is {_described(now)}"
        )
    if recorded.get("sha256") in (None, now.get("sha256")):
        return policy
    content = read() if isinstance(policy, Foreign) else None
    if content is None or not isinstance(policy, Foreign):
        raise RunError(
            f"{where} had the policy {_described(recorded)}, but now it is {_described(now)}: "
            "another checksum. Put back what it was trained with, or train anew"
        )
    if checksum(content) != recorded.get("sha256"):
        raise RunError(f"{where}: the copy of its policy is damaged: another checksum")
    return policy.restored(content)


def checksum(content: bytes) -> str:
    """SHA-256, as hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def qualified(thing: Any) -> str:
    """``module.qualname`` of a function or a class, or of an object's class."""
    if not hasattr(thing, "__qualname__"):
        thing = type(thing)
    return f"{thing.__module__}.{thing.__qualname__}"


def _described(source: dict[str, Any]) -> str:
    sha256 = f" (sha256 {source['sha256'][:12]}…)" if "sha256" in source else ""
    return f"{source['kind']} {(source.get('file') or source.get('name') or '')[:300]}{sha256}"


def made_up(space: Space[Any], n: int) -> Array:
    """n members of a space as one batch."""
    from skillweave.spaces import pack

    batch = batch_space(space, n)
    batch.seed(0)
    return pack(space, _tamed(batch, batch.sample()))


def _tamed(space: Space[Any], sample: Any) -> Any:
    """Without huge numbers: a space's bounds may be the largest floats there are."""
    if isinstance(space, Dict):
        return {name: _tamed(part, sample[name]) for name, part in space.spaces.items()}
    if isinstance(space, Tuple):
        return tuple(_tamed(p, s) for p, s in zip(space.spaces, sample, strict=True))
    if isinstance(space, Box) and np.issubdtype(space.dtype, np.floating):
        return sample.clip(-10, 10).clip(space.low, space.high).astype(space.dtype)
    return sample
