"""What reports show: calls by hand, transitions, films, seeds, groups, what is missing."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from reporting.cart import RECIPE
from reporting.walkway import CALLS, Moody, Walkway, declare, played, told

from skillweave import EnvSpec, SkillweaveError
from skillweave.cli import main
from skillweave.errors import EnvError
from skillweave.html_report import timelines
from skillweave.html_report.charts import scores
from skillweave.html_report.film import HOLD, episode_shot, make_film
from skillweave.reporting.curves import read_curves, thinned
from skillweave.reporting.facts import transition_rows, transitions
from skillweave.reporting.groups import grouped, on_one_grid, over_seeds
from skillweave.reporting.palette import hex_of, is_light
from skillweave.runs.directory import RunDirectory
from skillweave.training.evaluation import episode_seeds
from skillweave.training.played_calls import Episode


def test_transitions_by_hand(tmp_path):
    run = declare().train(tmp_path / "run", quiet=True)
    skills = run.evaluate(2).skills
    assert transitions(skills) == [[2, 0, 0], [2, 2, 2], [2, 0, 0]]
    older = {name: replace(report, first=0, followed={}) for name, report in skills.items()}
    assert transitions(older) is None
    start, go, stay = transition_rows(("go", "stay"), transitions(skills) or [])
    assert [cell["share"] for cell in start["cells"]] == [1, 0, 0]
    assert [cell["count"] for cell in go["cells"]] == ["2", "2", "2"]
    assert (stay["name"], stay["total"]) == ("stay", 2)


def test_calls_by_hand(tmp_path):
    log = played(tmp_path / "run", 2)
    assert (log.labels, log.judged) == (("go", "stay"), (True, False))
    for i, episode in enumerate(log.episodes):
        assert told(episode.calls) == CALLS
        assert episode.calls["start"].tolist() == [[0, 0], [2, 2], [2, 5], [4, 7]]
        assert episode.rewards.tolist() == [1, 2, 2, 2, 2, 3, 4, 5, 6]
        assert (episode.total, episode.seed, episode.cut) == (27, episode_seeds(0, 2)[i], False)
    found = timelines.decision_data(log)
    assert found["names"] == ["obs[0]", "obs[1]", "step of the episode"]
    assert found["rows"] == [[0, 0, 0], [2, 2, 2], [2, 5, 5], [4, 7, 7]] * 2
    assert told(found["calls"]) == CALLS * 2


def test_many_calls_are_shown_in_part(tmp_path, monkeypatch):
    log = played(tmp_path / "run", 3)
    shown, missing = timelines.episode_data(log, None)
    assert ([e["number"] for e in shown], missing) == ([1, 2, 3], [])
    assert told(shown[0]["calls"]) == CALLS
    monkeypatch.setattr(timelines, "MOST_CALLS", 5)
    monkeypatch.setattr(timelines, "MOST_CALLS_OF_ONE", 3)
    shown, missing = timelines.episode_data(log, None)
    assert [told(e["calls"]) for e in shown] == [CALLS[:3]]
    assert missing == [
        "Of the 4 calls of episode 1, 3 are shown.",
        "1 of 3 episodes are shown, as all have too many calls.",
    ]


def test_coordinates_of_unlike_observations():
    assert list(timelines.coordinates(np.zeros(3, np.int64))) == ["obs"]
    assert list(timelines.coordinates(np.zeros((3, 2, 2)))) == [f"obs[{i}]" for i in range(4)]
    assert timelines.coordinates(np.zeros((3, 84, 84, 3), np.uint8)) == {}
    parts = np.zeros(3, [("place", "f4", (2,)), ("camera", "u1", (64, 64)), ("key", "i8")])
    names = ['obs["place"][0]', 'obs["place"][1]', 'obs["key"]']
    assert list(timelines.coordinates(parts)) == names
    assert timelines.coordinates(np.array([[np.inf], [0.0]])) == {}


def test_filmed_are_the_worst_the_median_and_the_best():
    episodes = [
        Episode(i, np.zeros(1), np.array([r]), np.zeros(0))
        for i, r in enumerate([5.0, 1.0, 9.0, 3.0, 7.0])
    ]
    assert timelines.chosen_episodes(episodes, 3) == [1, 0, 2]
    assert timelines.chosen_episodes(episodes, 1) == [1]
    assert sorted(timelines.chosen_episodes(episodes, 9)) == [0, 1, 2, 3, 4]


def test_a_film_says_where_each_episode_begins(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    log = played(tmp_path / "run", 2)
    shots = {i: episode_shot(log.episodes[i]) for i in (1, 0)}
    film = make_film(EnvSpec(Walkway, engine="sync"), shots)
    # Nine steps, a frame for two, and the end, which stands for HOLD frames.
    assert film.first == {1: 0, 0: 5 + HOLD}
    assert (film.fps, film.every) == (10, 2)
    assert film.data[4:8] == b"ftyp"


def test_an_environment_that_does_not_repeat_itself_is_told(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    log = played(tmp_path / "run", env=Moody)
    with pytest.raises(EnvError, match="does not repeat itself"):
        make_film(EnvSpec(Moody, engine="sync"), {0: episode_shot(log.episodes[0])})


class Unseen(Walkway):
    """Has no pictures."""

    metadata: dict[str, Any] = {}  # noqa: RUF012

    def __init__(self) -> None:
        super().__init__()


@pytest.mark.slow
def test_an_environment_without_pictures_has_no_film_and_all_the_rest(tmp_path):
    pytest.importorskip("vl_convert")
    run = declare(Unseen).train(tmp_path / "run", quiet=True)
    told = run.report(episodes=2)
    (missing,) = told["missing"]
    assert missing.startswith("There is no film: ")
    assert told["path"] == str(tmp_path / "run" / "report.html")
    text = (tmp_path / "run" / "report.html").read_text()
    assert "Episodes, call by call" in text
    with pytest.raises(SkillweaveError, match="episodes is 0"):
        run.report(episodes=0)


def test_interquartile_means_and_intervals_over_seeds():
    alone = over_seeds(np.array([[1.0, 2.0]]))
    assert (alone.mean.tolist(), alone.low.tolist(), alone.bounds) == ([1, 2], [1, 2], {})
    many = np.random.default_rng(0).normal(5, 1, (40, 3))
    found = over_seeds(many)
    ordered = np.sort(many, axis=0)[10:30].mean(axis=0)
    np.testing.assert_allclose(found.mean, ordered)
    assert (found.low < found.mean).all()
    assert (found.mean < found.high).all()
    # About 1.96 standard errors of a mean of normal values, a little more for the middle half.
    width = (found.high - found.low) / 2
    assert ((width > 0.2) & (width < 0.6)).all()
    same = over_seeds(np.full(5, 3.0))
    assert (same.mean, same.bounds) == (3, {"low": 3, "high": 3})


def test_groups_of_one_seed_have_no_interval_to_draw():
    dot, bar = {"group": "A", "x": 1.0, "seed": 0}, {"group": "A", "x": 1.0}
    alone = scores("A", ["#000"], [dot], [bar])
    assert [layer["mark"]["type"] for layer in alone["layer"]] == ["point", "tick"]
    several = scores("A", ["#000"], [dot], [bar | {"low": 0.0, "high": 2.0}])
    assert [layer["mark"]["type"] for layer in several["layer"]] == ["rule", "point", "tick"]


def test_curves_of_several_seeds_on_one_grid():
    grid, values = on_one_grid([[(0, 0.0), (100, 10.0)], [(50, 5.0), (150, 25.0)]])
    assert (grid[0], grid[-1]) == (50, 100)
    np.testing.assert_allclose(values[0], grid / 10)
    np.testing.assert_allclose(values[1], 5 + (grid - 50) / 5)
    assert on_one_grid([[(0, 0.0), (10, 1.0)], [(20, 0.0), (30, 1.0)]]) is None


def test_thinned_keeps_the_last_point():
    assert thinned(list(range(10)), 4) == [0, 3, 6, 9]
    assert thinned([1, 2], 4) == [1, 2]


def test_a_word_on_a_colour_is_black_or_white():
    assert (is_light((255, 255, 255)), is_light((0, 0, 60))) == (True, False)
    assert hex_of((1, 255, 16)) == "#01ff10"


# Of runs that were trained


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Runs of one recipe: two seeds, one seed with another setting, and one unfinished."""
    found = tmp_path_factory.mktemp("runs")
    (found / "cart.py").write_text(RECIPE)
    train = ["train", str(found / "cart.py"), "--quiet", "--evaluate", "3"]
    for name, words in (("a", ()), ("b", ("--seed", "1")), ("c", ("--set", "call_steps=3"))):
        assert main([*train, "-o", str(found / name), *words]) == 0
    run = RunDirectory.open(found / "c")
    run.stage("balance").status = "training"
    run.stage("selector").status = "waiting"
    run.save()
    return found


@pytest.mark.slow
def test_groups_are_seeds_and_are_named_by_what_tells_them_apart(folder):
    runs = [RunDirectory.open(folder / name) for name in "abc"]
    first, second = grouped(runs)
    assert [r.manifest.seed for r in first.runs] == [0, 1]
    assert (first.key, first.name) == ("A", "cart, call_steps 5")
    assert (second.key, second.name) == ("B", "cart, call_steps 3")
    assert [g.name for g in grouped(runs[:2])] == ["cart"]
    with pytest.raises(SkillweaveError, match="the same settings and the same seed, 0"):
        grouped([runs[0], runs[0]])
    curves = read_curves(runs[0])  # of all agents
    assert [c.label for c in curves] == ["left", "balance", "selector"]
    steps = [x for x, _ in curves[0].points["policy_loss"]]
    assert steps == [64, 128, 192, 256]


def report(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    assert main([str(w) for w in ("report", *words, "--json", "--episodes", "2")]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


@pytest.mark.slow
def test_an_unfinished_run_is_shown_as_far_as_it_is(folder, tmp_path, capsys):
    pytest.importorskip("vl_convert")
    out = tmp_path / "c.html"
    told = report(capsys, folder / "c", "-o", out)
    first, second, third = told["missing"]
    assert first == "The stage 'balance' is not finished: it stands after 256 of 256 steps."
    assert second == "The stage 'selector' has not begun."
    assert third.endswith(
        f"To finish it: skillweave resume {folder / 'c'} --recipe {folder / 'cart.py'}"
    )
    text = out.read_text()
    assert told["bytes"] == len(text.encode())
    assert 'id="curve-0"' in text
    assert "256 of 256" in text  # the steps of the stage under way
    assert 'id="video"' not in text


def test_without_the_recipe_the_report_says_so_and_shows_the_rest(folder, tmp_path, capsys):
    pytest.importorskip("vl_convert")
    pytest.importorskip("imageio_ffmpeg")
    out = tmp_path / "a.html"
    coded = tmp_path / "coded"
    recipe = tmp_path / "coded.py"
    reflex = '    reflexes=[Reflex(lambda obs: obs[:, 2] > 0.1, action=1, name="<catch>")],\n'
    recipe.write_text(RECIPE.replace("    call_steps=5", reflex + "    call_steps=5"))
    train = ["train", recipe, "--quiet", "--evaluate", "2", "-o", coded, "--scale", "0.1"]
    assert main([str(w) for w in train]) == 0
    capsys.readouterr()
    (missing,) = report(capsys, coded, "-o", out)["missing"]
    assert "--recipe FILE.py" in missing
    assert "What each skill did" in out.read_text()
    assert report(capsys, coded, "-o", out, "--recipe", recipe)["missing"] == []
    assert "&lt;catch&gt;" in out.read_text()
    assert "<catch>" not in out.read_text()
