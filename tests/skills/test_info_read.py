"""The keys of info that a skill reads are found by calling it, or it names them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_asked_twice import step

from skillweave.errors import DeclarationError, SkillError
from skillweave.skills import Skill, asked
from skillweave.skills.info_words import StoredInfo
from skillweave.skills.reads import info_keys_read

INFO: dict[str, Any] = {
    "speed": np.arange(4.0),
    "parts": {"left": np.zeros(4)},
    "_speed": np.ones(4, bool),
    "won": np.zeros(4, bool),
}


class Paid(Skill):
    def reward(self, step: Any) -> Any:
        return step.info["speed"] + step.info["parts"]["left"]

    def termination(self, step: Any) -> Any:
        return step.info.get("won") | ("lost" in step.info)


class Helped(Paid):
    """Reads by another method, too."""

    def success(self, step: Any) -> Any:
        return self.fast(step)

    def fast(self, step: Any) -> Any:
        return step.info["_speed"] & (step.obs[:, 0] > 0)


class Anything(Skill):
    def reward(self, step: Any) -> Any:
        return sum(v for k, v in step.info.items() if k == "speed")


class Spread(Skill):
    def reward(self, step: Any) -> Any:
        return {**step.info}["speed"]


class Named(Anything):
    needs_info = ("speed",)


class Plain(Skill):
    pass


@pytest.mark.parametrize(
    ("skill", "keys"),
    [
        (Paid(), ("speed", "parts", "won", "lost")),
        (Helped(), ("speed", "parts", "won", "lost", "_speed")),
        (Named(), ("speed",)),
        (Plain(), ()),
    ],
)
def test_the_keys_that_a_skill_reads(skill: Skill, keys: tuple[str, ...]) -> None:
    given = replace(step(), info=INFO)
    assert info_keys_read(skill, given) == keys
    assert given.info is INFO


def test_keys_of_one_method() -> None:
    assert info_keys_read(Paid(), replace(step(), info=INFO), ("termination",)) == ("won", "lost")


@pytest.mark.parametrize("kind", [Anything, Spread])
def test_a_skill_that_goes_over_the_whole_info_must_name_its_keys(kind: Any) -> None:
    with pytest.raises(DeclarationError, match=rf"{kind.name}'.*reward\(\).*needs_info = "):
        info_keys_read(kind(), replace(step(), info=INFO))


def test_a_key_that_was_not_recorded_is_named() -> None:
    stored = replace(step(), info=StoredInfo(speed=np.zeros(4)))
    with pytest.raises(
        SkillError, match=r"'paid': reward\(\).*parts.*recorded: 'speed'.*needs_inf"
    ):
        asked(Paid(), "reward", stored)


@pytest.mark.parametrize("keys", ["speed", ("speed", 3), 7])
def test_needs_info_is_a_tuple_of_keys(keys: Any) -> None:
    class Wrong(Skill):
        needs_info = keys

    with pytest.raises(DeclarationError, match=r"needs_info.* is .*; it must be"):
        Wrong().validate()
