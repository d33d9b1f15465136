"""What is read is plain, bounded, and of its schema; messages name the file and the field."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NotRequired, TypedDict

import pytest

from skillweave.algorithms.config import DQN, PPO, config_from_json, config_to_json
from skillweave.errors import RunError
from skillweave.evolution.config import Evolution, evolution_from_json, evolution_to_json
from skillweave.policies.untrusted import DEEPEST, check_file, parse_json, read_file, shown
from skillweave.schema import LARGEST, AtLeastOne, Count, fit, fitted


class Inner(TypedDict):
    status: Literal["waiting", "done"]
    steps: NotRequired[Count]


@dataclass(frozen=True)
class Made:
    sizes: tuple[int, ...] = ()
    pair: tuple[int, float] = (1, 1.0)
    rate: float = 1.0


class Outer(TypedDict):
    parts: list[Inner]
    limit: AtLeastOne | None
    made: NotRequired[Made]
    names: NotRequired[dict[str, str]]
    on: NotRequired[bool]


GOOD: dict[str, Any] = {"parts": [{"status": "done"}], "limit": None}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"parts": 5}, "x.json: parts is 5; it must be a list"),
        ({"parts": [None]}, "x.json: parts[0] is None; it must be an object, in braces"),
        ({"parts": [{}]}, "x.json is damaged: parts[0] has no field 'status'"),
        (
            {"parts": [{"status": "done"}, {"status": 5}]},
            "x.json: parts[1].status is 5; it must be one of waiting, done",
        ),
        (
            {"parts": [{"status": "done", "steps": -1}]},
            "parts[0].steps is -1; it must be at least 0",
        ),
        ({"limit": 0}, "limit is 0; it must be at least 1"),
        ({"limit": LARGEST}, "limit is 9223372036854775808; it must be below 2^63"),
        ({"made": {"sizes": [1, "a"]}}, "made.sizes[1] is 'a'; it must be a whole number"),
        ({"made": {"pair": [1]}}, "made.pair is [1]; it must be a list of 2"),
        ({"made": {"rate": float("nan")}}, "made.rate is nan; it must be a finite number"),
        ({"made": {"rate": 10**400}}, "it must be below 2^63"),
        ({"made": {"rate": 1e39}}, "made.rate is 1e+39; it must be below 3.4e38"),
        ({"made": {"size": 1}}, "x.json: made has no field size: made by a newer version?"),
        ({"names": {"a": 1}}, "names['a'] is 1; it must be a text"),
        ({"names": {"a": "b" * 5000}}, "it must be a text of at most 4096 characters"),
        ({"on": 1}, "on is 1; it must be true or false"),
    ],
)
def test_what_does_not_fit_is_told_by_its_field(change, says):
    with pytest.raises(RunError) as caught:
        fit(Outer, GOOD | change, "x.json")
    assert says in str(caught.value)
    assert len(str(caught.value)) < 200


def test_what_fits_comes_back_with_dataclasses_made_and_other_fields_kept():
    data = GOOD | {"made": {"sizes": [1, 2], "pair": [3, 4]}, "new": 5}
    assert fit(Outer, data, "x.json") == data | {"made": Made((1, 2), (3, 4))}
    assert fitted(Count, 2**62, "PPO.num_envs") == 2**62


def test_a_long_value_is_shown_short():
    assert len(shown("x" * 10_000)) == 60
    assert shown(10**5000) == "a int"
    deep: list[Any] = []
    for _ in range(5000):
        deep = [deep]
    assert shown(deep) == "a list"


# Settings


@pytest.mark.parametrize("value", [5, "a", [[]], {"a": 1}, float("inf")])
def test_an_evolution_of_wrong_types_is_told_by_its_field(value):
    data = evolution_to_json(Evolution())
    for name in ("population", "selection", "mutations", "start"):
        if name == "population" and value == 5:
            continue
        with pytest.raises(RunError, match=f"^runs/x.* evolution.{name}"):
            evolution_from_json(data | {name: value}, "runs/x")
    changed = data | {"mutations": data["mutations"] | {"units": [value]}}
    with pytest.raises(RunError, match=r"^runs/x: evolution\.mutations\.units"):
        evolution_from_json(changed, "runs/x")


# Files and JSON


HALF = "half of a character"
DAMAGED: list[tuple[Any, str]] = [
    ("[" * 5000 + "]" * 5000, ""), ("[" * 500 + "]" * 500, ""), ("NaN", ""), ("[1e999]", ""),
    (b"\xff", ""), ("9" * 5000, ""), ("{", ""), ('["\\ud800"]', HALF),
    ('{"a": {"\\udc00": 1}}', HALF), ('["\ud800"]', HALF), (b'["\xed\xa0\x80"]', HALF),
    ('["\\ud800"]'.encode("utf-16-le"), HALF),
]  # fmt: skip


@pytest.mark.parametrize(("text", "says"), DAMAGED, ids=range(len(DAMAGED)))
def test_json_that_could_not_be_written_is_damaged(text, says):
    with pytest.raises(RunError, match=rf"x\.json is damaged.*{says}"):
        parse_json(text, "x.json")


def test_json_may_be_nested_up_to_a_limit_and_have_characters_however_they_are_written():
    depth = DEEPEST - 1
    assert str(parse_json("[" * depth + "1" + "]" * depth, "x")).count("[") == depth
    for text in ('["\\ud83d\\ude00"]', '["😀"]', '["😀"]'.encode()):
        assert parse_json(text, "x.json") == ["😀"]


def test_what_is_no_plain_file_or_too_large_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    for path, says in (
        (tmp_path / "pipe", "a pipe or a device"),
        (tmp_path / "link", "a pipe or a device"),
        (tmp_path, "is a directory"),
        (tmp_path / "none", "does not exist"),
        (Path("a\0b"), "cannot be read"),
    ):
        with pytest.raises(RunError, match=says):
            check_file(path)
    with (tmp_path / "x").open("wb") as file:
        file.truncate(10**12)
    with pytest.raises(RunError, match=r"1,000,000,000,000 bytes.*at most 100"):
        read_file(tmp_path / "x", 100)


@pytest.mark.parametrize("kind", [PPO, DQN])
@pytest.mark.parametrize("compile", [True, False, "auto"])
def test_a_setting_that_is_yes_no_or_a_word_comes_back_from_json(kind, compile):
    again: Any = config_from_json(config_to_json(kind(compile=compile)))
    assert again.compile is compile or again.compile == compile == "auto"
