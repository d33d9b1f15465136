"""``sw.handovers``: every entry as a plain loop plays it, its counts by hand, untidy owners."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import gymnasium as gym
import numpy as np
import pytest
from robots.owner import plainly, policies, up

import skillweave as sw
from skillweave.errors import DeclarationError, EnvError, PolicyError, SkillError
from skillweave.robots.counts import exact_chance
from skillweave.robots.measured import Entry
from skillweave.robots.measuring import MORE, MeasuredHandovers
from skillweave.toys.balancer import Balancer

VARY = {"latency": (0, 1), "grip": (0.8, 1.0)}


@pytest.fixture(scope="module")
def found() -> MeasuredHandovers:
    return sw.handovers(
        Balancer, policies(), steps=80, stays=up, calls=8, vary=VARY, seed=3, quiet=True
    )


# What is played


def test_each_entry_is_what_a_plain_loop_plays(found: MeasuredHandovers) -> None:
    assert len({e.after for e in found.entries}) == 5
    for entry in found.entries:
        calls = [(entry.skill, 80)]
        if entry.after != "start":
            calls.insert(0, (entry.after, entry.cut))
        *before, (good, steps) = plainly(entry.seed, entry.settings, calls)
        assert all(ok for ok, _ in before)
        assert (entry.counts, entry.steps) == (good, steps)


def test_robots_are_the_same_in_all_pairs_and_first_skills_are_cut_at_drawn_steps(
    found: MeasuredHandovers,
) -> None:
    robots: dict[int, Any] = {}
    cuts: dict[tuple[int, str], int] = {}
    for entry in found.entries:
        assert robots.setdefault(entry.robot, (entry.seed, entry.settings)) == (
            entry.seed,
            entry.settings,
        )
        assert cuts.setdefault((entry.robot, entry.after), entry.cut) == entry.cut
    drawn = {cut for (_, after), cut in cuts.items() if after == "fast"}
    assert min(drawn) >= 40
    assert max(drawn) <= 80
    assert len(drawn) > 4
    assert {settings["latency"] for _, settings in robots.values()} == {0, 1}
    assert all(0.8 <= settings["grip"] <= 1.0 for _, settings in robots.values())


def test_pairs_that_differ_are_played_on_more_robots_and_judged_by_these(
    found: MeasuredHandovers,
) -> None:
    worst = found.pairs[0]
    assert (worst.after, worst.skill) == ("fast", "wave")
    assert (worst.calls, worst.done, worst.lost) == (8 + MORE, 0, 8 + MORE)
    assert worst.chance == exact_chance(MORE, 0)
    assert found.pair("stand", "wave").calls == 8
    assert next((p.after, p.skill) for p in found.clearly_worse()) == ("fast", "wave")
    assert found.alone("wave") == (8 + MORE, 8 + MORE)
    assert "wave after fast" in str(found)


def test_the_same_seed_measures_the_same_and_another_one_other_robots() -> None:
    def measured(seed: int) -> Any:
        skills = {k: v for k, v in policies().items() if k in ("slow", "wave")}
        entries = sw.handovers(
            Balancer, skills, steps=60, stays=up, calls=3, vary=VARY, seed=seed, quiet=True
        ).entries
        return [entry.to_json() for entry in entries]

    assert measured(1) == measured(1)
    assert measured(1) != measured(2)


def test_what_stands_between_two_skills_is_judged_by_both_pairs(found: MeasuredHandovers) -> None:
    between = found.between("fast", "wave")
    assert between.direct.estimate == 0.0
    best = next(chain for chain in between.chains if chain.skills[1] == "stand")
    assert between.chains[0].estimate == 1.0
    assert best.estimate == 1.0
    assert best.interval[0] < 0.9  # eight entries do not prove it
    assert "stand" in str(between)


# What counts


class Line(gym.Env[Any, Any]):
    """A number from 0 on; an action adds itself. With ``info``, and a limit."""

    observation_space = gym.spaces.Box(-99, 99, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, limit: int = 1000, wall: float = 50.0) -> None:
        self.limit, self.wall = limit, wall

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.at, self.time = float(self.np_random.uniform(0, 0.5)), 0
        return np.array([self.at], np.float32), {}

    def step(self, action: Any) -> Any:
        self.at += float(action[0])
        self.time += 1
        obs = np.array([self.at], np.float32)
        return obs, 0.0, abs(self.at) > self.wall, self.time >= self.limit, {"at": self.at}


def moving(by: float) -> Any:
    return sw.from_function(lambda obs: np.full((len(obs), 1), by))


LINE = {"right": moving(1.0), "left": moving(-1.0)}


def test_done_must_happen_once_and_stays_all_the_time() -> None:
    def far(obs: Any) -> Any:
        return obs[:, 0] > 9.0

    def near(obs: Any) -> Any:
        return obs[:, 0] > -2.0

    found = sw.handovers(
        Line, LINE, steps=20, done={"right": far}, stays={"left": near}, calls=4, quiet=True
    )
    assert found.alone("right") == (4, 4)
    assert found.alone("left")[0] == 0  # below -2 after three steps
    pair = found.pair("right", "left")
    most = 4 + MORE
    assert (pair.calls, pair.done, pair.won) == (most, most, most)  # from 20 it stays above -2
    assert all(e.cut == 20 for e in found.entries if e.after == "right")  # has to be done first
    assert found.pair("left", "right").calls == 0
    assert dict(found.no_entry)["left"][0] > 0
    text = "\n".join(found.sentences())
    assert "'left' is never done, not even from a fresh start" in text
    assert "'right' has no entry after 'left'" in text
    assert "vary=" in text


def test_what_was_asked_for_must_be_followed() -> None:
    seen = []

    def faster(call: sw.Step) -> Any:
        seen.append(call)
        assert (np.diff(call.next_obs[:, 0]) > 0).all()
        return call.info["at"][-1] - call.info["at"][0] > 5.0

    skills = {"slowly": moving(0.1), "fast": moving(1.0)}
    found = sw.handovers(
        Line, skills, steps=10, stays=lambda obs: obs[:, 0] > -50, follows=faster, calls=3,
        quiet=True,
    )  # fmt: skip
    assert found.alone("slowly") == (0, 3)
    assert found.alone("fast") == (3, 3)
    assert found.pair("slowly", "fast").done == 3  # one that stays is an entry
    assert found.pair("fast", "slowly").not_followed == 3
    assert {len(call.reward) for call in seen} == {10}


def test_a_skill_of_its_own_ends_by_itself_and_succeeds_by_itself() -> None:
    class Right(sw.Skill):
        policy = moving(1.0)

        def termination(self, step: sw.Step) -> Any:
            return step.next_obs[:, 0] > 5

        success = termination

    class Left(sw.Skill):
        policy = moving(-1.0)
        max_steps = 7

        def initiation(self, obs: Any) -> Any:
            return obs[:, 0] > 3

        def success(self, step: sw.Step) -> Any:
            return step.timed_out

    found = sw.handovers(Line, [Right(), Left()], steps=30, calls=3, quiet=True)
    rows = {(e.after, e.skill): e for e in found.entries}
    assert rows["start", "right"].steps in (5, 6)
    assert rows["right", "left"].steps == 7
    assert rows["right", "left"].counts
    assert rows["start", "left"].refused
    assert found.alone("left") == (0, found.alone("left")[1])
    assert found.pair("left", "right").calls == 0


def test_the_exact_chance_by_hand() -> None:
    assert exact_chance(0, 0) == 1.0
    assert exact_chance(1, 1) == 1.0
    assert exact_chance(8, 0) == 2 / 2**8
    assert exact_chance(0, 3) == 0.25
    assert exact_chance(10, 3) == pytest.approx(2 * (1 + 13 + 78 + 286) / 2**13)


def test_chances_of_chains_are_products_and_their_intervals_know_the_counts() -> None:
    def entries(after: str, skill: str, done: int, of: int) -> list[Entry]:
        return [Entry(i, i, after, skill, 1, 1, i < done, i < done, False) for i in range(of)]

    cells = [("start", "a", 20, 20), ("start", "b", 15, 20), ("a", "b", 10, 20), ("b", "a", 8, 16)]
    found = MeasuredHandovers(
        ("a", "b"), tuple(e for cell in cells for e in entries(*cell)), 20, (1, 1)
    )
    one = found.chain("a", "b", "a")
    assert one.estimate == pytest.approx(1.0 * 0.5 * 0.5)
    assert 0.05 < one.interval[0] < 0.25 < one.interval[1] < 0.5
    pair = found.pair("a", "b")
    assert (pair.lost, pair.won, pair.alone) == (5, 0, 15)
    assert found.chain("a").interval[0] < 0.95  # twenty of twenty are no certainty
    with pytest.raises(DeclarationError, match="'c'"):
        found.chain("a", "c")
    with pytest.raises(DeclarationError, match="goes on"):
        found.chain("a", "a")


def test_a_pair_is_judged_by_later_robots_or_by_all_of_them_where_these_are_few() -> None:
    def pair_of(later: int) -> Any:
        entries = [Entry(i, i, "start", "b", 0, 1, True, True, False) for i in range(58 + later)]
        entries += [Entry(i, i, "a", "b", 1, 1, False, False, False) for i in range(58 + later)]
        return MeasuredHandovers(("a", "b"), tuple(entries), 58, (1, 1)).pair("a", "b")

    assert pair_of(0).chance == exact_chance(58, 0)
    assert pair_of(2).chance == 2 * exact_chance(60, 0)  # two looks
    assert pair_of(30).chance == exact_chance(30, 0)


def test_where_no_skill_may_start_the_call_is_refused() -> None:
    class Near(sw.Skill):
        policy = moving(1.0)

        def initiation(self, obs: Any) -> Any:
            return obs[:, 0] < 3

    class Here(sw.Skill):
        policy = moving(-1.0)
        initiation = Near.initiation

    found = sw.handovers(Line, [Near(), Here()], steps=8, stays=upright, calls=2, quiet=True)
    assert found.alone("near") == (2, 2)
    assert found.pair("near", "here").refused == 2
    assert found.pair("here", "near").done == 2


def test_a_fall_after_it_was_done_is_a_fall() -> None:
    class Falls(Line):
        def step(self, action: Any) -> Any:
            obs, reward, _, truncated, info = super().step(action)
            return obs, reward, self.time == 8, truncated, info

    def far(obs: Any) -> Any:
        return obs[:, 0] > 3

    def count(**aim: Any) -> Any:
        skills = {"right": moving(1.0)}
        return sw.handovers(Falls, skills, steps=20, calls=2, quiet=True, **aim).alone("right")

    assert count(stays=upright, done=far) == (0, 2)
    assert count(done=far) == (2, 2)

    def at_the_end(obs: Any) -> Any:
        return obs[:, 0] > 7.9

    assert count(stays=upright, done=at_the_end) == (2, 2)  # the task is over


def test_calls_that_are_whole_at_the_time_limit_count() -> None:
    class Short(sw.Skill):
        call_steps = 7
        policy = moving(1.0)

    class Other(Short):
        policy = moving(0.5)

    def env() -> Any:
        return Line(limit=14)

    found = sw.handovers(env, [Short(), Other()], steps=30, stays=upright, calls=2, quiet=True)
    assert found.pair("short", "other").done == 2


# Ways to it


def test_it_is_written_as_json_and_shown_in_a_notebook(
    found: MeasuredHandovers, tmp_path: Path
) -> None:
    content = json.loads(found.save(tmp_path / "found.json").read_text())
    assert content["pairs"][0]["skill"] == "wave"
    assert content["entries"][0]["vary.latency"] in (0, 1)
    assert len(content["entries"]) == len(found.entries)
    page = found.save(tmp_path / "found.html").read_text()
    assert page.count("48 of 48") >= 1
    assert "0 of 48" in found.save(tmp_path / "found.svg").read_text()
    assert "<svg" in found._repr_html_()
    ElementTree.fromstring(found.save(tmp_path / "found.svg").read_text())
    with pytest.raises(DeclarationError, match="no folder"):
        found.save(tmp_path / "nowhere" / "found.svg")
    numbers = sw.handovers(
        Line, LINE, steps=3, stays=upright, calls=1, quiet=True,
        vary={"wall": list(np.arange(40, 42)), "limit": (np.int64(50), np.int64(60))},
    )  # fmt: skip
    assert json.loads(numbers.save(tmp_path / "numbers.json").read_text())["robots"] == 1
    with pytest.raises(DeclarationError, match=r"\.svg"):
        found.save(tmp_path / "found.png")


FILE = """
import skillweave as sw
from robots.owner import policies, up
from skillweave.toys.balancer import Balancer as env

skills = {name: policy for name, policy in policies().items() if name != "slow"}
steps = 60
stays = up
vary = {"latency": (0, 1)}
calls = 30
"""


def test_the_command_reads_a_file(
    tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from skillweave.cli import main

    monkeypatch.chdir(tmp_path)
    Path("pair.py").write_text(FILE)
    assert main(["handover", "pair.py", "--calls", "2", "--out", "all.json", "--quiet"]) == 0
    assert "wave after fast" in capsys.readouterr().out
    assert json.loads(Path("all.json").read_text())["calls"] == 2
    assert main(["handover", "pair.py", "--out", "all.png"]) == 1
    assert ".svg" in capsys.readouterr().err
    Path("wrong.py").write_text(FILE.replace("steps = 60", "step = 60"))
    assert main(["handover", "wrong.py"]) == 1
    assert "'steps'" in capsys.readouterr().err
    assert main(["handover", "missing.py"]) == 1


def test_ctrl_c_keeps_what_is_measured() -> None:
    asked = [0]

    def stays(obs: Any) -> Any:
        asked[0] += 1
        if asked[0] == 900:
            os.kill(os.getpid(), signal.SIGINT)
        return up(obs)

    with pytest.warns(UserWarning, match="stopped"):
        found = sw.handovers(Balancer, policies(), steps=50, stays=stays, quiet=True)
    assert found.stopped
    assert 0 < len(found.entries) < 16
    assert "stopped" in str(found)


# Untidy owners


def ignoring() -> gym.Env[Any, Any]:
    env = Line()
    draws = iter(range(1000))
    reset = env.reset

    def other(**_: Any) -> Any:
        return reset(seed=next(draws))

    env.reset = other  # type: ignore[method-assign]
    return env


def counting() -> Any:
    """A policy that changes after some calls."""
    asked = [0]

    def act(obs: Any) -> Any:
        asked[0] += 1
        return np.full((len(obs), 1), 0.1 * (asked[0] // 12))

    return sw.from_function(act)


def upright(obs: Any) -> Any:
    return obs[:, 0] > -90


WRONG: dict[str, tuple[Any, Any, dict[str, Any], type[Exception], str]] = {
    "no aim": (Line, LINE, {"stays": None}, DeclarationError, "stays="),
    "ignores its seed": (ignoring, LINE, {}, EnvError, "np_random"),
    "refuses a keyword": (Line, LINE, {"vary": {"latency": (0, 1)}}, EnvError, "latency"),
    "no range": (Line, LINE, {"vary": {"wall": 5}}, DeclarationError, r"vary\['wall'\]"),
    "upside down": (Line, LINE, {"vary": {"wall": (5, 1)}}, DeclarationError, "lowest"),
    "time limit": (lambda: Line(limit=15), LINE, {}, EnvError, "time limit"),
    "at the cut": (lambda: Line(limit=10), LINE, {"cut": (10, 10)}, EnvError, "time limit"),
    "cut": (Line, LINE, {"cut": (9, 3)}, DeclarationError, "cut"),
    "steps of whom": (Line, LINE, {"steps": {"right": 3}}, DeclarationError, "'left'"),
    "stays of whom": (Line, LINE, {"stays": {"rihgt": upright}}, DeclarationError, "right"),
    "no function": (Line, LINE, {"stays": True}, DeclarationError, "predicate"),
    "not one answer": (Line, LINE, {"follows": lambda c: c.reward > 0}, SkillError, "one True"),
    "fails": (Line, LINE, {"follows": lambda c: c.speed}, SkillError, "speed"),
    "other actions": (
        Line,
        {"a": sw.from_function(lambda obs: np.zeros((len(obs), 3)))},
        {},
        PolicyError,
        "'a'",
    ),
    "NaN": (Line, {"a": moving(float("nan"))}, {}, PolicyError, "NaN"),
    "a hidden state": (Line, {"right": moving(1.0), "odd": counting()}, {}, EnvError, "'odd'"),
    "a name": (Line, {"start": moving(1.0)}, {}, DeclarationError, "fresh start"),
    "no policy": (Line, [type("Move", (sw.Skill,), {})()], {}, DeclarationError, "no policy"),
    "no skills": (Line, "right", {}, DeclarationError, "by name"),
    "goals": (
        Line,
        [type("To", (sw.Skill,), {"goal_space": gym.spaces.Box(0, 1, (1,)), "policy": staticmethod(
            lambda obs, goal: goal)})()],
        {},
        DeclarationError,
        "with_goal",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_mistakes_end_in_a_sentence(case: str) -> None:
    env, skills, given, kind, words = WRONG[case]
    with pytest.raises(kind, match=words):
        sw.handovers(env, skills, **({"steps": 10, "stays": upright, "quiet": True} | given))


def test_a_run_of_ready_skills_and_choices_of_actions_serve_as_well(tmp_path: Path) -> None:
    class Balance(sw.Skill):
        def policy(self, obs: Any) -> Any:
            return (obs[:, 2] + 0.5 * obs[:, 3] > 0).astype(np.int64)

    class Lean(sw.Skill):
        def policy(self, obs: Any) -> Any:
            return (obs[:, 2] > 0).astype(np.int64)

    hierarchy = sw.Hierarchy(
        "CartPole-v1", [Balance(), Lean()], selector=lambda obs: ["balance"] * len(obs)
    )
    run = hierarchy.train(tmp_path / "run", quiet=True)

    def held(obs: Any) -> Any:
        return abs(obs[:, 2]) < 0.2

    ways = [run.policy, hierarchy.skills]
    results = [
        sw.handovers("CartPole-v1", way, steps=40, stays=held, calls=4, quiet=True).entries
        for way in ways
    ]
    assert results[0] == results[1]
    assert len(results[0]) >= 12


def test_a_policy_with_a_goal_is_copied_with_another_one() -> None:
    drive = sw.from_function(lambda x: x, sees=(0, sw.Goal(low=-1, high=1)))
    assert drive.with_goal((0.5,)).mapping.goal == (0.5,)
    assert drive.mapping.goal is None
    with pytest.raises(DeclarationError, match=r"with_goal\(\).*out of the range"):
        drive.with_goal((7.0,))
    with pytest.raises(DeclarationError, match=r"with_goal\(\).*does not take it"):
        moving(1.0).with_goal((0.5,))
