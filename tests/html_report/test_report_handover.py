"""The handover section of a report: its matrix, the calls that it films, and what is missing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from reporting.walkway import Walkway, declare

from skillweave import EnvSpec
from skillweave.calls import CallLog
from skillweave.html_report import film, matrix as page
from skillweave.html_report.film import HOLD
from skillweave.html_report.matrix import add_handover
from skillweave.html_report.page import Page
from skillweave.runs.directory import CALLS

pytest.importorskip("imageio_ffmpeg")


class Ragged(Walkway):
    """A walk that begins at a place drawn by its seed, and may become moody."""

    mood = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.at = int(np.random.default_rng(seed).integers(0, 3)) + self.mood
        return self._seen(), {}


@pytest.fixture
def run(tmp_path):
    return declare(Ragged).train(tmp_path / "run", quiet=True)


@pytest.fixture
def log(run):
    return run.log_calls(400, num_envs=4)


def section(log: CallLog, filmed: bool = True) -> Page:
    page = Page()
    add_handover(page, log, EnvSpec(Ragged), {}, {}, filmed=filmed)
    return page


def test_the_matrix_and_the_ends(log):
    words = section(log, filmed=False).context["handover"]
    matrix = log.handover()
    assert [row["name"] for row in words["rows"]] == ["start of an episode", "go", "stay"]
    for i, row in enumerate(words["rows"]):
        for j, cell in enumerate(row["cells"]):
            assert (cell is None) == (matrix.calls[i, j] == 0)
            if cell is not None:
                assert cell["count"] == f"{matrix.done[i, j]} of {matrix.calls[i, j]}"
                assert cell["share"] == pytest.approx(matrix.rate[i, j])
    assert words["matrix"].skills == ("go", "stay")
    assert "without success() (stay)" in words["matrix"].meaning
    go, stay = words["ends"]
    assert (go["name"], stay["name"]) == ("go", "stay")
    assert stay["ends"][1] == "100 %"
    assert words["called"] == ["go", "stay"]


def test_calls_are_played_again_as_they_were(log, monkeypatch):
    reached: list[tuple[Any, Any]] = []
    play = film._play

    def watch(shot: Any, env: Any, engine: Any, video: Any, every: int, progress: Any) -> None:
        before = video.frames
        play(shot, env, engine, video, every, progress)
        assert video.frames - before == -(-(len(shot.actions) - shot.first) // every) + HOLD
        reached.append((shot, env.unwrapped._seen()))

    monkeypatch.setattr(film, "_play", watch)
    log = replace(log, succeeded=np.random.default_rng(0).random(len(log)) < 0.7)
    made = section(log)
    assert made.missing == []
    assert made.context["hand_film"] is not None
    assert len(reached) > 4
    ends = {(int(log.seed[row]), int(log.age[row] + log.tau[row])): log.end[row].tolist()
            for row in range(len(log))}  # fmt: skip
    for shot, seen in reached:
        assert seen.tolist() == ends[shot.seed, len(shot.actions)]
    cells = made.data["handover"]["cells"]
    assert {clip["done"] for cell in cells.values() for clip in cell["clips"]} == {True, False}
    for cell in cells.values():
        for clip in cell["clips"]:
            assert clip["from"] <= clip["call"] < clip["to"]
            assert (clip["from"] < clip["call"]) == bool(cell["before"])


def test_only_calls_whose_episodes_are_whole_are_played_again(log):
    assert page._playable(log).all()
    without_first = log.take(np.flatnonzero((log.order > 0) | (log.episode > 0)))
    playable = page._playable(without_first)
    assert (playable == (without_first.episode > 0)).all()
    unknown = replace(log, seed=np.full(len(log), -1))
    made = section(unknown)
    assert (made.context["hand_film"], made.missing) == (None, [])
    assert all(cell["clips"] == [] for cell in made.data["handover"]["cells"].values())


def test_what_does_not_fit_the_environment_is_not_filmed(log, monkeypatch):
    made = section(replace(log, action=log.action + 7))  # a log from elsewhere may hold anything
    assert "the log has the action" in made.missing[0]
    assert made.context["hand_film"] is None
    other = gym.spaces.Discrete(3)
    made = section(replace(log, action_space=other))
    assert "the log has actions of Discrete(3)" in made.missing[0]
    monkeypatch.setattr(Ragged, "mood", 1)
    made = section(log)
    assert made.context["hand_film"] is None
    assert "it does not repeat itself" in made.missing[0]
    assert made.missing[0].startswith("There is no film of handovers: ")


def test_few_points_and_a_short_film_of_many_calls(log, monkeypatch):
    monkeypatch.setattr(page, "MOST_POINTS", 60)
    monkeypatch.setattr(page, "MOST_FILMED", 6)
    monkeypatch.setattr(page, "MOST_FRAMES", 4)
    data = section(log).data["handover"]
    assert max(map(len, data["points"].values())) <= 60 // len(data["points"]) + 1
    assert sum(len(cell["clips"]) for cell in data["cells"].values()) in (1, 2, 3)
    assert data["names"] == ["obs[0]", "obs[1]"]
    # Images have no chart.
    flat = {name: np.zeros((*getattr(log, name).shape[:1], 70), np.float32)
            for name in ("start", "next_obs")}  # fmt: skip
    space = gym.spaces.Box(-1, 1, (70,), np.float32)
    made = section(replace(log, observation_space=space, **flat), filmed=False)
    assert made.data["handover"]["names"] == []
    assert made.context["handover"]["where"] == []


@pytest.mark.slow
def test_the_page_has_it_where_the_run_has_a_log(run, log):
    pytest.importorskip("vl_convert")
    page = run.report(episodes=1, films=1, quiet=True)
    text = Path(page["path"]).read_text()
    assert page["missing"] == []
    assert 'id="hand-film"' in text
    assert "Handover: does the next skill work?" in text
    (run.path / CALLS).write_bytes(b"damaged")
    page = run.report(episodes=1, films=0, quiet=True)
    assert "There is no handover: " in page["missing"][0]
    assert 'id="handover"' not in Path(page["path"]).read_text()
