"""The life of a call, the same for all that let skills act, to the bit: against plain Python."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from calls.reference import Call, Choices as Chosen, Moment, calls, episode
from calls.users import GAMMA, SEED, USERS, Got, Played, User, plain
from calls.worlds import ACTIONS, GOALS, RESTS, SEES, SELECTORS, World, WorldLevel, world
from reference_calls import T, Walk, scripted, seeds_of
from toy_acting import Choices, requests
from toys import calling_in

from skillweave._internal.seeding import Seeds
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.experience.decisions import SMOOTHED
from skillweave.hierarchy.options_env import OptionsEnv
from skillweave.policies.core import CallEnd
from skillweave.skills import Skill
from skillweave.skills.skill_set import SkillSet
from skillweave.types import Array

# Functions of the worlds choose at random, also what a mask forbids.
pytestmark = pytest.mark.filterwarnings("ignore:.*action mask forbids")


@lru_cache(64)
def expected(number: int, seed: int, learns: str) -> list[Moment]:
    return episode(world(number), seed, learns)


def check(user: User, world: World) -> None:
    """Every step of a user is the reference's, and every decision that it learns from."""
    if not user.can_play(world):
        return
    played = user.plays(world)
    assert played.episodes
    found = []
    for seed, steps in played.episodes:
        if user.chooses:
            sampled = replace(world, level=replace(world.level, greedy=False))
            wanted = episode(sampled, seed, choices=choices_of(world.level, steps))
        else:
            wanted = expected(world.seed, seed, user.learns)
        compare(user, played, seed, steps, wanted)
        found.append(wanted[: len(steps)])
    if played.finished is not None:
        over = [moments for moments in found if moments[-1].over]
        returns = sorted((sum(m.reward for m in moments), len(moments)) for moments in over)
        assert near(sorted(played.finished), returns)
    if played.columns is not None:
        root = SEED if user.learns == "outside" else (Seeds(SEED) / "env").integer()
        compare_decisions(world, user, played.columns, root)


def compare(user: User, played: Played, seed: int, steps: list[Got], wanted: list[Moment]) -> None:
    assert len(steps) <= len(wanted)
    for t, (got, want) in enumerate(zip(steps, wanted, strict=False)):
        where = f"step {t} of the episode from seed {seed}"
        agree(user, got.acted, want.acted, f"{where}, after acting")
        assert got.action == plain(want.action), where
        assert got.next_obs == plain(want.next_obs), where
        assert got.reward == want.reward, where
        assert got.overridden in (None, want.overridden), where
        if got.observed:
            over = played.restarts and want.over
            after = {"end": CallEnd.EPISODE} if over else want.observed
            agree(user, got.observed, after, f"{where}, after the step")


def agree(user: User, got: dict[str, Any], want: dict[str, Any], where: str) -> None:
    """What is remembered agrees."""
    for name, value in want.items():
        if re.search(user.missing, name):
            continue
        if isinstance(value, list):
            assert near(got[name], value), f"{where}: {name} is {got[name]}, not {value}"
        else:
            assert got[name] == value, f"{where}: {name}"


def near(got: Any, want: Any) -> bool:
    """Numbers agree, but for rounding."""
    if np.shape(got) != np.shape(want):
        return False
    return bool((np.abs(np.subtract(got, want, dtype=np.float64)) < 1e-5).all())


def choices_of(level: WorldLevel, steps: list[Got]) -> Chosen:
    """What a user has chosen that chooses by itself."""
    found: Chosen = []
    for memory in (s.acted for s in steps if s.acted["elapsed"] == 0):
        skill, number, goal = level.skills[memory["skill"]], memory["skill"], None
        if level.lengths:
            number = number * len(level.lengths) + level.lengths.index(memory["length"])
        if skill.goal is not None:
            goal = memory[f"goal.{memory['skill']}"]
            kinds = {"number": np.int64, "place": np.float32}
            goal = (
                {"at": np.float32(goal[0]), "side": np.int64(goal[1])}
                if skill.goal == "both"
                else kinds[skill.goal](goal)
            )
        found.append((number, goal))
    return found


def compare_decisions(
    world: World, user: User, columns: list[list[dict[str, Any]]], root: int
) -> None:  # fmt: skip
    """Every row is the reference's next call in its environment."""
    level = world.level
    masks = any(s.starts for each in level.all for s in each.skills) or level.guide is not None
    for column, own in zip(columns, seeds_of(root, len(columns)), strict=True):
        episodes = (expected(world.seed, seed, user.learns) for seed in own)
        in_order = (call for moments in episodes for call in calls(moments))
        for row in column:
            assert ("mask" in row) == ("next_mask" in row) == masks
            told = level.guide is not None and level.guide_tells
            assert ("guide" in row) == told
            compare_decision(row, next(in_order))


def compare_decision(row: dict[str, Any], call: Call) -> None:
    decision, last = call.decision, call.moments[-1]
    rewards, steps = [m.reward for m in call.moments], len(call.moments)
    wanted = {
        "obs": call.moments[0].obs,
        "action": decision.choice,
        "next_obs": last.next_obs,
        "steps": steps,
        "terminated": last.terminated,
        "truncated": last.truncated,
        "reward": sum(GAMMA**k * reward for k, reward in enumerate(rewards)),
        "mask": decision.mask,
        "next_mask": [True] * len(last.ahead) if last.terminated else last.ahead,
        "episode_start": call.first,
        "recurrent_state": decision.before.get("rnn"),
        "dist_params": [decision.choice],
        "discount": 0.0 if last.terminated else GAMMA**steps,
        "call_return": sum(rewards),
    }
    if "rewards" in row:
        wanted["rewards"] = [*rewards, *[0.0] * (len(row["rewards"]) - steps)]
    if "guide" in row:
        uniform = np.array(decision.mask) / sum(decision.mask)
        mixed = (1 - SMOOTHED) * np.array(decision.chances) + SMOOTHED * uniform
        wanted["guide"] = np.log(np.maximum(mixed, 1e-8))
    assert row.keys() <= wanted.keys()
    assert row["reward"] == np.float32(wanted["reward"]), "not to the last bit"
    for name in ("obs", "next_obs"):
        assert plain(row.pop(name)) == plain(wanted[name]), name
    chosen = row.pop("action")  # with goals, these stand behind the number, or beside it
    number = chosen["skill"] if chosen.dtype.names else np.ravel(chosen)[0]
    assert number == decision.choice
    for name in row:
        assert near(row[name], wanted[name]), f"{name} is {row[name]}, not {wanted[name]}"


@pytest.mark.parametrize("user", USERS)
@pytest.mark.parametrize("seed", range(50))
def test_a_world_is_played_as_the_reference_does(seed: int, user: str) -> None:
    check(USERS[user], world(seed))


@pytest.mark.slow
@pytest.mark.parametrize("first", range(50, 600, 25))
def test_many_more_worlds_are_played_as_the_reference_does(first: int) -> None:
    for seed in range(first, first + 25):
        for user in USERS.values():  # all of them while the reference's episodes are cached
            check(user, world(seed))


def test_the_worlds_show_all_that_can_be_declared() -> None:
    """In the reference, in the seeds of the fast test."""
    seen: Counter[str] = Counter()
    for seed in range(50):
        for moments in (episode(world(seed), start, "all", seen) for start in range(40, 48)):
            for name, value in (pair for m in moments for pair in m.observed.items()):
                if name.endswith("end"):
                    seen[f"{'first' if name == 'end' else 'below'} {CallEnd(value).name}"] += 1
            seen["an override"] += sum(moment.overridden for moment in moments)
            seen["terminated" if moments[-1].terminated else "truncated"] += 1
    few = {name: count for name, count in seen.items() if count < 5}
    assert not few
    assert set(seen) == {
        *(f"{depth} {end.name}" for depth in ("first", "below") for end in CallEnd),
        *(f"{kind} actions" for kind in ACTIONS),
        *(f"acts of {kind}" for kind in ACTIONS),
        *(f"rests of {kind}: {rest}" for kind, rests in RESTS.items() for rest in rests),
        *(f"a goal of {kind}" for kind in GOALS),
        *(f"sees {name}" for name in SEES),
        *(f"a {policy} acts" for policy in ("network", "recurrent", "function", "watching")),
        *(f"a correction of a {policy}" for policy in ("function", "watching")),
        *(f"a {selector} selects" for selector in SELECTORS),
        *(f"a {guide} guides" for guide in ("last", "automaton")),
        "a critic that sees goals", "a fixed goal", "a goal that is clipped",
        "a guide that restricts nothing", "a hierarchy anew", "a hierarchy with a goal",
        "a length is chosen", "a mask", "a mask of a part", "a mask of choices",
        "a skill samples", "after another one", "again at once", "an override", "chosen again",
        "it goes on after a choice that was no call", "stuck", "terminated",
        "the same again, at last", "three levels", "truncated",
    }  # fmt: skip


class AtFirst(Skill):
    """May start in the first step of an episode."""

    def initiation(self, obs: Array) -> Array:
        return obs[:, T] == 0


def test_where_no_skill_may_start_all_choices_are_open_to_the_value_of_what_follows() -> None:
    skills = SkillSet((AtFirst(), AtFirst()), (scripted(0), scripted(2)), call_steps=20)
    engines = (make_engine(EnvSpec(Walk, engine="sync"), 20) for _ in range(2))
    env = OptionsEnv(next(engines), skills, GAMMA)
    env.reset(seed=0)
    *_, truncated, info = env.step(np.zeros(20, int))
    assert truncated.any()
    assert info["next_action_mask"].all()
    collector = calling_in(next(engines), Choices(20, 2), skills)
    collector.start(Seeds(SEED))
    batch = collector.collect(next(requests(20))).batches[""]
    assert batch["truncated"][batch.valid_rows].any()
    assert batch["next_mask"][batch.valid_rows].all()
