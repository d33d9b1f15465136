"""The life of a call, the same for all that let skills act, against one environment in Python."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from calls.cases import BY_HAND, LEFT, SEEN, ZIGZAG, Case, LevelCase, SkillCase, cases
from calls.reference import Call, Moment, calls, episode, moments_of
from calls.users import GAMMA, SEED, USERS, Got, Played, plain
from hypothesis import HealthCheck, given, settings
from reference_calls import T, scripted, seeds_of

from skillweave._internal.seeding import Seeds
from skillweave.experience.calls import SMOOTHED
from skillweave.policies.core import CallEnd
from skillweave.policies.hierarchy import unless_none
from skillweave.skills import Skill
from skillweave.skills.lengths import Lengths
from skillweave.skills.skill_set import SkillSet, hierarchy_of
from skillweave.types import Array


def compare(case: Case, played: Played) -> list[list[Moment]]:
    """Every step is the reference's; returns the reference's episodes."""

    def wanted(seed: int, steps: list[Got]) -> list[Moment]:
        return episode(case, seed, None if played.chooses else choices_of(case.level, steps))

    return compare_with(wanted, played)


def compare_with(
    episode_of: Callable[[int, list[Got]], list[Moment]], played: Played
) -> list[list[Moment]]:
    """The same; ``episode_of``: from a seed, and the steps of the user."""
    found = []
    assert played.episodes
    for seed, steps in played.episodes:
        wanted = episode_of(seed, steps)
        assert len(steps) <= len(wanted)
        for t, (got, want) in enumerate(zip(steps, wanted, strict=False)):
            where = f"step {t} of the episode from seed {seed}"
            agree(played, got.acted, want.acted, f"{where}, after acting")
            assert got.action == plain(want.action), where
            assert got.next_obs == plain(want.next_obs), where
            assert got.reward == want.reward, where
            assert got.overridden in (None, want.overridden), where
            if got.observed:
                over = played.restarts and want.over
                after = {"end": CallEnd.EPISODE} if over else want.observed
                agree(played, got.observed, after, f"{where}, after the step")
        found.append(wanted[: len(steps)])
    return found


def agree(played: Played, got: dict[str, Any], want: dict[str, Any], where: str) -> None:
    for name, value in want.items():
        if re.search(played.missing, name):
            continue
        if isinstance(value, list):
            assert near(got[name], value), f"{where}: {name} is {got[name]}, not {value}"
        else:
            assert got[name] == value, f"{where}: {name}"


def compare_finished(played: Played, found: list[list[Moment]]) -> None:
    """The episodes that are over have the reference's returns and lengths."""
    over = [moments for moments in found if moments[-1].over]
    wanted = sorted((sum(m.reward for m in moments), len(moments)) for moments in over)
    assert played.finished is not None
    assert near(sorted(played.finished), wanted)


def near(got: Any, want: Any) -> bool:
    """Numbers agree, but for rounding."""
    if np.shape(got) != np.shape(want):
        return False
    return bool((np.abs(np.subtract(got, want, dtype=np.float64)) < 1e-5).all())


def choices_of(level: LevelCase, steps: list[Got]) -> tuple[int, ...]:
    """What a user has chosen that chooses by itself."""
    begins = (s.acted for s in steps if s.acted["elapsed"] == 0)
    if not level.lengths:
        return tuple(m["skill"] for m in begins)
    return tuple(m["skill"] * len(level.lengths) + level.lengths.index(m["length"]) for m in begins)


def compare_decisions(case: Case, played: Played, root: int) -> None:
    """Every row is the reference's next call in its environment."""
    assert played.columns is not None
    seeds = seeds_of(root, len(played.columns))
    masks = any(s.starts for level in case.level.all for s in level.skills)
    masks |= case.level.guide is not None
    for column, own in zip(played.columns, seeds, strict=True):
        calls_in_order = (call for seed in own for call in calls(episode(case, seed)))
        assert len(column) >= 2, "two episodes are over at least"
        for row in column:
            assert ("mask" in row) == ("next_mask" in row) == masks
            assert ("guide" in row) == (case.level.guide == "automaton")
            compare_decision(row, next(calls_in_order))


def compare_decision(row: dict[str, Any], call: Call) -> None:
    steps, decision = len(call.rewards), call.decision
    ahead = [True] * len(call.ahead) if call.terminated else call.ahead
    wanted = {
        "obs": call.obs,
        "action": decision.choice,
        "next_obs": call.next_obs,
        "steps": steps,
        "terminated": call.terminated,
        "truncated": call.truncated,
        "reward": sum(GAMMA**k * reward for k, reward in enumerate(call.rewards)),
        "mask": decision.mask,
        "next_mask": ahead,
        "episode_start": call.first,
        "recurrent_state": decision.before.get("rnn"),
        "dist_params": [decision.choice],
        "discount": 0.0 if call.terminated else GAMMA**steps,
        "call_return": sum(call.rewards),
    }
    if "rewards" in row:
        each = row["rewards"]
        wanted["rewards"] = [*call.rewards, *[0.0] * (len(each) - steps)]
    if "guide" in row:
        uniform = np.array(decision.mask) / sum(decision.mask)
        mixed = (1 - SMOOTHED) * np.array(decision.chances) + SMOOTHED * uniform
        wanted["guide"] = np.log(np.maximum(mixed, 1e-8))
    assert row.keys() <= wanted.keys()
    assert row["reward"] == np.float32(wanted["reward"]), "not to the last bit"
    for name in row:
        assert near(row[name], wanted[name]), f"{name} is {row[name]}, not {wanted[name]}"


def as_played(case: Case, user: str) -> Case:
    """The case as a user plays it: skills that lead to start states sample."""
    if user != "start states":
        return case
    return replace(case, level=replace(case.level, greedy=False))


def check(case: Case, user: str) -> list[list[Moment]]:
    play, fits = USERS[user]
    assert fits(case)
    played = play(case)
    case = as_played(case, user)
    found = compare(case, played)
    if played.finished is not None:
        compare_finished(played, found)
    if played.columns is not None:
        root = SEED if user == "OptionsEnv" else (Seeds(SEED) / "env").integer()
        compare_decisions(case, played, root)
    return found


@pytest.mark.parametrize(
    ("name", "user"), [(n, u) for n, case in BY_HAND.items() for u in USERS if USERS[u][1](case)]
)
def test_a_case_by_hand_is_played_as_the_reference_does(name: str, user: str) -> None:
    check(BY_HAND[name], user)


def drawn(user: str, examples: int) -> None:
    @settings(max_examples=examples, suppress_health_check=[HealthCheck.filter_too_much])
    @given(cases().filter(USERS[user][1]))
    def play(case: Case) -> None:
        check(case, user)

    play()


@pytest.mark.parametrize("user", USERS)
def test_any_case_is_played_as_the_reference_does(user: str) -> None:
    drawn(user, 12)


@pytest.mark.slow
@pytest.mark.parametrize("user", USERS)
def test_many_more_cases_are_played_as_the_reference_does(user: str) -> None:
    drawn(user, 100)


@pytest.mark.usefixtures("no_trials")
@pytest.mark.parametrize("user", USERS)
def test_a_skill_sees_the_steps_of_its_own_calls(user: str) -> None:
    """Also the action that reflexes left, and its own time."""
    shows = SkillCase("right", max_steps=3, stops="recorded")
    below = SkillCase(LevelCase((shows, ZIGZAG), 2), max_steps=5, stops="recorded")
    case = Case(LevelCase((shows, below, LEFT), 4, ("clock",)))
    SEEN.clear()
    played = USERS[user][0](case)
    seen = set(SEEN)
    SEEN.clear()
    for seed, steps in played.episodes:
        choices = None if played.chooses else [*choices_of(case.level, steps)]
        [*moments_of(as_played(case, user), seed, choices)]
    assert len(seen) > 30
    assert not seen - set(SEEN)
    if user in ("player", "decisions", "joint", "evaluation"):  # others end before episodes do
        ends = {row[-5:-3] for row in seen}  # terminated, truncated
        assert ends == {(False, False), (True, False), (False, True)}


def test_the_cases_by_hand_show_what_can_happen() -> None:
    """In the reference: ends of all kinds at each depth, memories that go on and that do not."""
    seen: Counter[str] = Counter()
    for case in BY_HAND.values():
        if case.level.env == "LunarLander":
            continue
        episodes = [episode(case, seed) for seed in range(40, 60)]
        assert {moments[-1].terminated for moments in episodes} == {False, True}
        for moments in episodes:
            for one, then in itertools.pairwise(moments):
                happened(one, then, seen)
    assert min(seen.values()) > 5, seen
    assert set(seen) == {
        *(f"{depth} {end.name}" for depth in ("first", "below") for end in list(CallEnd)[:4]),
        "again at once", "after another one", "an override", "a mask",
    }  # fmt: skip


def happened(one: Moment, then: Moment, seen: Counter[str]) -> None:
    for name, value in one.observed.items():
        if name.endswith("end"):
            seen[f"{'first' if name == 'end' else 'below'} {CallEnd(value).name}"] += 1
    seen["an override"] += then.overridden
    if then.decision is not None:
        same = one.acted["skill"] == then.acted["skill"]
        seen["again at once" if same else "after another one"] += 1
        seen["a mask"] += not all(then.decision.mask)


class AtFirst(Skill):
    """May start in the first step of an episode."""

    def initiation(self, obs: Array) -> Array:
        return obs[:, T] == 0


def test_where_no_skill_may_start_all_choices_are_open_to_the_value_of_what_follows() -> None:
    skills = AtFirst(), AtFirst()
    policy = hierarchy_of(SkillSet(skills, (scripted(0), scripted(2)), call_steps=Lengths(1, 2)))
    obs = np.zeros((2, 4), np.float32)
    obs[1, T] = 1
    assert unless_none(policy.may_start(obs)).all()
