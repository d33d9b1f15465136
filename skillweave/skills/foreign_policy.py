"""Policies made elsewhere: their fit to an environment and their record in a run."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from gymnasium import Space

from skillweave._internal.messages import error_text, short
from skillweave._internal.notices import notice
from skillweave._internal.policy_protocol import Memoryless, Policy
from skillweave._internal.tracebacks import is_own_code
from skillweave.errors import PolicyError, RunError, SkillweaveError
from skillweave.policies.core import Array
from skillweave.policies.spaces import at, space_of
from skillweave.policies.untrusted import checksum
from skillweave.skills.function_state import examples
from skillweave.skills.goal_spaces import draw_from
from skillweave.skills.probing import look_at
from skillweave.skills.rows import Call

EXAMPLES = 16
"""The number of example observations on which a policy is tried out."""
SEES = "let sees= give the parts that it takes"
ACTS = "let acts= say what its outputs mean"
"""Advice on a policy with other spaces, for messages."""


class Foreign(Memoryless):
    """A policy made elsewhere; its spaces may be unknown until ``bind``.

    A run records its ``source``. If it has ``content``, the run keeps a copy, and the copy acts
    when the run is loaded. Without content, its checksum must not have changed then.
    """

    kind: str
    """The name of its kind in ``run.json``."""
    suffix: str = ""
    """The suffix of the file of its ``content``."""
    act: Callable[..., Any]
    """Acts, as ``types.Policy`` says."""

    def __init__(self, name: str, observation_space: Any = None, action_space: Any = None) -> None:
        self.name = self._who = name
        self.observation_space = observation_space
        self.action_space = action_space
        self._open = observation_space is None, action_space is None

    def bind(self, observation_space: Space[Any], action_space: Space[Any], who: str) -> Self:
        """Return a copy that has ``observation_space`` and ``action_space`` where it has none.

        ``who`` begins messages.
        """
        bound = copy.copy(self)
        bound._who = f"{who}: {self.name}"
        if self._open[0]:
            bound.observation_space = observation_space
        if self._open[1]:
            bound.action_space = action_space
        return bound

    def source(self) -> dict[str, Any]:
        """Return the fields of its ``Source``, at least its kind."""
        content = self.content()
        sha256 = {} if content is None else {"sha256": checksum(content)}
        return {"kind": self.kind, "name": self.name, **sha256}

    def content(self) -> bytes | None:
        """Return the bytes that a run copies; None: the run only names the policy."""
        return None

    def restored(self, content: bytes) -> Self:
        """Return this policy with the ``content`` from a run."""
        raise NotImplementedError

    def try_out(self) -> None:
        """Act once on two example observations, to find errors before training.

        Raises:
            PolicyError: it failed; the message names the policy and the space.
        """
        try:
            with examples(getattr(self, "function", None)):
                self.act(self.start(2), made_up(self.observation_space, 2))
        except SkillweaveError:
            raise
        except (Exception, SystemExit) as error:
            raise self._failure(error) from error

    def _failure(self, error: BaseException) -> PolicyError:
        """Return the error of a call that failed; it names the policy and its inputs."""
        text = f"{error_text(error)}{self._advice_on(error)}"
        return PolicyError(f"{self._who} fails on {self.given}: {text}")

    @property
    def given(self) -> str:
        """Return the policy's input in words, for messages."""
        return f"observations of {short(self.observation_space, 300)}"

    def _advice_on(self, error: BaseException) -> str:
        """Return advice where the policy failed when it was tried out; empty: none."""
        return ""


def fitted(
    policy: Policy, observation_space: Space[Any], action_space: Space[Any], who: str, env: str
) -> Policy:
    """Return the policy, ready to act on the spaces of the environment named ``env``.

    Raises:
        PolicyError: it does not fit; the message names ``who`` and both spaces.
    """
    if isinstance(policy, Foreign):
        policy = policy.bind(observation_space, action_space, who)
    check_spaces(policy, observation_space, action_space, f"{who}: its policy", env)
    if isinstance(policy, Foreign):
        policy.try_out()
    return policy


def _other_parts(mine: Space[Any], theirs: Space[Any]) -> str:
    """Return a clause on parts that only the space of a foreign policy, or the other, has."""
    ours, others = (getattr(space, "spaces", None) for space in (mine, theirs))
    if not isinstance(ours, Mapping) or not isinstance(others, Mapping):
        return ""
    names = ", ".join(map(repr, sorted(map(str, ours.keys() ^ others.keys()))))
    return f" (only one of them has {names})" if names else ""


def check_spaces(
    policy: Policy, observation_space: Space[Any], action_space: Space[Any], whose: str, env: str
) -> None:
    """Raise a PolicyError where the spaces of a policy are not those of the environment ``env``.

    If only the bounds of actions differ, a notice says that its numbers are not scaled; another
    one, that a policy of the user's class keeps a state in itself. ``whose`` begins messages.
    """
    from skillweave.spaces import other_bounds, same_space  # needs torch, which declaring does not

    for kind, mine, theirs, advice in (
        ("observation_space", policy.observation_space, observation_space, SEES),
        ("action_space", policy.action_space, action_space, ACTS),
    ):
        if not same_space(mine, theirs):
            raise PolicyError(
                f"{whose} has {kind} {mine}, but the environment {env} has {theirs}"
                + _other_parts(mine, theirs)
                + f": {advice}" * hasattr(policy, "mapping")
            )
    if other_bounds(policy.action_space, action_space):
        notice(
            f"{whose} has actions of {short(policy.action_space, 200)}, but the environment {env} "
            f"takes {short(action_space, 200)}: its numbers are used as they are, and clipped. "
            "Scale them: acts=Acts(scale=...) of a policy from elsewhere, or the wrapper "
            "gymnasium.wrappers.RescaleAction. If they are right, write acts=Acts()"
        )
    if is_own_code(type(policy)):
        _look_at_own(policy, observation_space, whose)


def _look_at_own(policy: Policy, observation_space: Space[Any], whose: str) -> None:
    """Look at the actions of a policy of the user's class for examples."""

    def act(obs: Array) -> Any:
        return policy.act(policy.start(len(obs)), obs)[0]

    obs = made_up(observation_space, EXAMPLES)
    with examples(policy):
        look = look_at(Call(act, (obs,), owner=policy), False)
        try:
            action = act(obs)
        except (Exception, SystemExit):
            return  # it is raised where the policy acts
        if look is not None:
            look.check(action, whose, PolicyError)


@dataclass
class Source:
    """The source of a ready policy."""

    kind: str
    name: str | None = None
    file: str | None = None
    sha256: str | None = None
    """Checksum of its content, if it can be computed."""
    mapping: dict[str, Any] | None = None
    """Its mapping from observations to actions, if it has one."""

    def __str__(self) -> str:
        sha256 = "" if self.sha256 is None else f" (sha256 {self.sha256[:12]}...)"
        return f"{self.kind} {(self.file or self.name or '')[:300]}{sha256}"


def source_of(policy: Policy) -> Source:
    """Return the source of a ready policy.

    A policy may have a method ``source`` that returns its fields, with a checksum; for others it
    is the name of the class.
    """
    method = getattr(policy, "source", None)
    given: dict[str, Any] = method() if callable(method) else {}
    return Source(**{"kind": "policy", "name": qualified(type(policy))} | given)


def as_recorded(
    policy: Policy,
    recorded: Source | None,
    read: Callable[[], bytes | None],
    where: str,
) -> Policy:
    """Return a skill's ready policy as of when ``recorded`` was its source; ``read`` reads a copy.

    Raises:
        RunError: the policy has another kind, or another checksum without a copy; or the copy or
            the recorded mapping is damaged, or does not fit.
    """
    if recorded is None:  # an old run, without sources
        return policy
    now = source_of(policy)
    if now.kind != recorded.kind:
        raise RunError(f"{where} had a policy of kind {recorded}, but now it is {now}")
    if recorded.mapping != now.mapping:
        if not hasattr(policy, "remapped"):
            raise RunError(f"{where} had a policy with a mapping, but now it has none")
        policy = policy.remapped(recorded.mapping, where)
        names = ", ".join([*_changed(recorded.mapping, now.mapping)][:4])
        notice(
            f"{where}: the mapping of its policy is declared otherwise now ({names}); the recorded "
            "one acts. To use the new one, start a new run"
        )
    if recorded.sha256 in (None, now.sha256):
        return policy
    if not isinstance(policy, Foreign) or (content := read()) is None:
        raise RunError(
            f"{where} had the policy {recorded}, but now it is {now}: another "
            "checksum. Restore the policy that it was trained with, or train again"
        )
    if checksum(content) != recorded.sha256:
        raise RunError(f"{where}: the copy of its policy is damaged: another checksum")
    return policy.restored(content)


def _changed(then: Any, now: Any, name: str = "") -> Iterator[str]:
    """Yield the names of settings that differ between two mappings: ``sees[0].scale``."""
    if isinstance(then, dict | None) and isinstance(now, dict | None):
        then, now = then or {}, now or {}
        for key in dict.fromkeys([*then, *now]):
            inner = f"{name}.{key}".strip(".") if key else name
            yield from _changed(then.get(key), now.get(key), inner)
    elif isinstance(then, list) and isinstance(now, list) and len(then) == len(now):
        for i, (one, other) in enumerate(zip(then, now, strict=True)):
            yield from _changed(one, other, f"{name}[{i}]")
    elif then != now:
        yield name


def qualified(thing: Any) -> str:
    """Return ``module.qualname`` of a function or a class, or of an object's class."""
    if not hasattr(thing, "__qualname__"):
        thing = type(thing)
    return f"{thing.__module__}.{thing.__qualname__}"


def made_up(space: Space[Any], n: int) -> Array:
    """Draw n elements of a space, none of them huge, to try out a policy from elsewhere."""
    drawn = draw_from(space, n, np.random.default_rng(0))
    for path, leaf in space_of(space).leaves.items():
        part = at(drawn, path)
        if part.dtype.kind == "f":
            part[...] = part.clip(-10, 10).clip(*leaf.bounds)
    return drawn
