"""The pictures of success over goals in a report."""

from __future__ import annotations

import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from goals.worlds import SPACES, Drawn, GoTo, Rest, aim_of, declared

from skillweave import Run
from skillweave.html_report.charts import choices
from skillweave.html_report.matrix import add_handover
from skillweave.html_report.page import Page
from skillweave.html_report.single import Played, play_episodes
from skillweave.html_report.timelines import decision_data
from skillweave.skills.goal_spaces import shown_goal


def play(run: Run, episodes: int, num_envs: int = 2) -> tuple[Page, Played]:
    page = Page()
    return page, play_episodes(
        page, run.policy, run.declaration.spec, episodes, 0, 0, True, num_envs
    )


def handover(*given: Any) -> dict[str, Any]:
    page = Page()
    add_handover(page, *given, filmed=True)
    return page.data["handover"]["cells"]


def walks(name: str, space: Any, left: float = 1.0) -> Any:
    """A skill that goes to its goal, and slowly where the goal's first number is below 0.5."""

    def policy(self: Any, obs: Any, goal: Any) -> Any:
        slow = np.where(aim_of(goal)[:, :1] < 0.5, left, 1.0)
        return np.clip(5 * (aim_of(goal) - obs), -1, 1) * slow

    return type("Walk", (GoTo,), {"name": name, "goal_space": space, "policy": policy})()


def chosen(obs: Any) -> Any:
    r, kind = np.abs(np.sin(obs * 37)), np.abs(obs[:, 0] * 100).astype(int) % 4
    goals = {"two": r, "number": 2 + (r[:, 0] * 9).astype(int) % 3, "one": r[:, :1]}
    goals["other"] = {"at": r, "side": (r[:, 0] > 0.5).astype(int)}
    return np.array(["two", "number", "one", "other"])[kind], goals


def test_each_kind_of_goals_has_its_picture(tmp_path):
    two = gym.spaces.Box(-0.5, 1.5, (2,), np.float32)  # wider than the goals
    one = gym.spaces.Box(0, np.inf, (1,), np.float32)
    skills = [
        walks("two", two, left=0.0),
        walks("number", SPACES["number"]),
        walks("one", one),
        walks("other", SPACES["dict"]),
    ]
    run = declared(skills, selector=chosen).train(tmp_path / "run", quiet=True)
    page, played = play(run, 30, 4)
    found = {picture["name"]: picture for picture in page.context["goals"]}
    assert set(found) == {"two", "number", "one"}  # goals of a Dict have none
    for name, picture in found.items():
        rows = picture["spec"]["data"]["values"]
        calls = sum(row["calls"] for row in rows)
        report = played.score.skills[name]
        assert calls == report.calls
        assert sum(row["done"] for row in rows) == report.succeeded
        assert picture["words"].startswith(f"{report.succeeded:,} of {report.calls:,} calls")
    encoding = found["two"]["spec"]["encoding"]
    assert [encoding[axis]["scale"]["domain"] for axis in "xy"] == [[-0.5, 1.5]] * 2
    rows = found["two"]["spec"]["data"]["values"]
    assert all(-0.5 <= row["x"] < row["x2"] <= 1.5 for row in rows)
    left = [row["share"] for row in rows if row["x2"] <= 0.5]
    right = [row["share"] for row in rows if row["x"] >= 0.5]
    assert np.mean(left) < 0.3 < np.mean(right)
    assert [row["x"] for row in found["number"]["spec"]["data"]["values"]] == ["2", "3", "4"]
    assert max(row["x2"] for row in found["one"]["spec"]["data"]["values"]) <= 1.0


def test_each_call_has_its_goal_in_words(tmp_path):
    two, number = walks("two", SPACES["box"]), walks("number", SPACES["number"])

    def selector(obs: Any) -> Any:
        names = np.where(obs[:, 0] < 0, "two", np.where(obs[:, 1] < 0, "number", "rest"))
        return names, {"two": obs.clip(-1, 1), "number": np.full(len(obs), 3)}

    run = declared([two, number, Rest()], selector=selector).train(tmp_path / "run", quiet=True)
    page, played = play(run, 12, 4)
    seen = set()
    for shown, episode in zip(page.data["episodes"], played.log.episodes, strict=True):
        for words, call in zip(shown["calls"]["goal"], episode.calls, strict=True):
            skill = played.log.labels[call["skill"]]
            goal = shown_goal(call["start"].clip(-1, 1)) if skill == "two" else "3"
            assert words == ("" if skill == "rest" else goal)
            seen.add(skill)
    assert seen == {"two", "number", "rest"}


def test_a_log_of_calls_has_pictures_of_its_own(tmp_path):
    pytest.importorskip("vl_convert")
    inner = declared([walks("walk", SPACES["box"])], selector=passes_on)
    far = type("Far", (GoTo,), {"policy": inner, "max_steps": 8})()

    def selector(obs: Any) -> Any:
        return ["far"] * len(obs), np.full((len(obs), 2), 0.5)

    run = declared([far, Rest()], selector=selector).train(tmp_path / "run", quiet=True)
    log = run.log_calls(300)
    run.report(tmp_path / "report.html", episodes=4, films=0)
    page = (tmp_path / "report.html").read_text()
    calls = int((log.skill == 0).sum())
    assert re.findall(r"<h3>([a-z/]+)</h3>\s*<p class=.hint.>Success in", page) == [
        *("far", "far/walk"),  # played
        "far",  # logged
    ]
    assert re.search(rf"of {calls} calls of the run’s log", page)


def passes_on(obs: Any) -> Any:
    return ["walk"] * len(obs), obs["goal"]


def test_films_of_handovers_and_choices_name_goals(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    skills = [walks("two", SPACES["box"]), walks("other", SPACES["dict"]), Rest()]

    def selector(obs: Any) -> Any:
        names = np.where(obs[:, 0] < 0, "two", np.where(obs[:, 1] < 0, "other", "rest"))
        side = (obs[:, 0] > 0.2).astype(int)
        return names, {"two": -obs.clip(-1, 1), "other": {"at": -obs.clip(-1, 1), "side": side}}

    run = declared(skills, env=Drawn, selector=selector).train(tmp_path / "run", quiet=True)
    log, spec = run.log_calls(400, num_envs=2), run.declaration.spec
    with_goals = {skill.name: skill for skill in skills[:2]}
    cells = handover(log, spec, {}, with_goals)
    clips = [(cell, clip) for cell in cells.values() for clip in cell["clips"]]
    assert {cell["skill"] for cell, _ in clips} == {"two", "other", "rest"}
    for cell, clip in clips:
        for skill, goal in ((cell["skill"], "goal"), (cell["before"], "before_goal")):
            form = {"two": r"\(\S+, \S+\)", "other": r"\(at \(\S+, \S+\), side [01]\)"}
            assert re.fullmatch(form.get(skill, ""), clip[goal])
    logged = {shown_goal(goal.astype(np.float32)) for goal in log.goals["two"][log.skill == 0]}
    assert {clip["goal"] for cell, clip in clips if cell["skill"] == "two"} <= logged
    assert {
        clip["goal"] for cell in handover(log, spec, {}, {}).values() for clip in cell["clips"]
    } == {""}

    played = play(run, 4)[1]
    decisions = decision_data(played.log)
    goals = [goal for episode in played.log.episodes for goal in episode.calls["goal"]]
    assert decisions["calls"]["goal"] == goals
    assert len(goals) == len(decisions["rows"])
    fields = [
        [f["field"] for f in choices(["two"], ["red"], goals=g)["encoding"]["tooltip"]]
        for g in (True, False)
    ]
    assert fields == [["what", "x", "y", "goal"], ["what", "x", "y"]]


def test_a_report_without_goals_has_none(tmp_path):
    rule = np.vectorize(lambda x: "rest")
    run = declared([Rest()], selector=lambda obs: rule(obs[:, 0])).train(quiet=True)
    assert play(run, 2)[0].context["goals"] == []
