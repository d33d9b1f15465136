"""What a report says in words: the verdict, digits, names, reflexes, docstrings."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from reporting.walkway import CALLS, Go, Stay, Walkway, choose, declare, played, told
from small_runs import stage_entry

from skillweave import EnvSpec, Hierarchy, Reflex, Run, Skill
from skillweave.envs.obs_names import GYMNASIUM
from skillweave.html_report import timelines
from skillweave.html_report.compare import write_comparison
from skillweave.html_report.single import score_words
from skillweave.reporting.facts import about, no_verdict, number, percent, verdict
from skillweave.runs.directory import RunDirectory
from skillweave.training.evaluation import Evaluation
from skillweave.training.evaluation_file import save_evaluation
from skillweave.training.skill_report import SkillReport
from skillweave.types import Array


def skill(steps: int, called: int, succeeded: int | None = None) -> SkillReport:
    return SkillReport(steps, called, {}, succeeded, None)


def scored(returns: list[float], **more: Any) -> Evaluation:
    return Evaluation(tuple(returns), (10,) * len(returns), more.pop("threshold", None), **more)


# Digits


@pytest.mark.parametrize(
    ("value", "scale", "text"),
    [
        (273.44, None, "273"),
        (27.344, None, "27.3"),
        (0.0273, None, "0.0273"),
        (1234567.0, None, "1,234,567"),
        (0.00001234, None, "1.23e−05"),
        (-3.0, None, "−3"),
        (-0.001, 300, "0"),
        (1.5, 30, "1.5"),
        (2.0, 3, "2.00"),
        (0.0, None, "0"),
        (None, None, "–"),
    ],
)
def test_digits_fit_the_scale(value, scale, text):
    assert number(value, scale) == text


def test_a_share_that_is_not_quite_all_or_nothing_does_not_look_like_it():
    shares = (0.0, 0.001, 0.42, 0.999, 1.0, None)
    assert [percent(share) for share in shares] == ["0 %", "<1 %", "42 %", ">99 %", "100 %", "–"]


def test_returns_of_0_and_1_are_percent_and_others_are_not():
    words = score_words(scored([1.0] * 19 + [0.0]))
    assert (words["solved"], words["solved_interval"]) == ("95 %", "76 % to 99 %")
    assert words["binary"]
    words = score_words(scored([200.0, 300.5]))
    assert (words["mean"], words["solved"], words["binary"]) == ("250", None, False)
    words = score_words(scored([0.5, 0.25], succeeded=1))
    assert (words["solved"], words["mean"], words["binary"]) == ("50 %", "0.375", False)


# The verdict


@pytest.mark.parametrize(
    ("score", "says"),
    [
        (
            scored(
                [1.0] * 29 + [0.0],
                skills={"go": skill(50, 9), "hover": skill(50, 40, 10)},
            ),
            "Solves 97 % of 30 episodes, so probably 83 % to 99 % of all; every skill is used; "
            "`hover` succeeds in only 25 % of its 40 calls.",
        ),
        (scored([1.0, 0.0]), "Solves 1 of 2 episodes: too few to judge."),
        (scored([3.25]), "Mean return 3.25 over one episode: too few to judge."),
        (
            scored([250.0, 150.0] * 5, threshold=200.0, cut=1),
            "Reaches the environment's threshold of 200 in 50 % of 10 episodes (mean return 200); "
            "1 episode never ended.",
        ),
        (
            scored(
                [1.0, 3.0] * 4,
                skills={
                    "a": skill(98, 4, 4),
                    "b": skill(0, 0),
                    "c": skill(2, 2),
                    "c/d": skill(2, 2, 0),
                },
            ),
            "Mean return 2.00 over 8 episodes (95 % interval 1.26 to 2.74); `a` acts in 98 % of "
            "the steps; `b` is never called; `c/d` succeeds in none of its 2 calls.",
        ),
        (
            scored([5.0] * 6, succeeded=3, skills={"a": skill(999, 4), "b": skill(1, 1, 0)}),
            "Solves 50 % of 6 episodes, so probably 19 % to 81 % of all; `a` acts in >99 % of the "
            "steps; `b` acts in less than 1 % of the steps; `b` does not succeed in its only call.",
        ),
        (
            scored([2.0], skills={"in": skill(10, 1), "in/a": skill(5, 1), "in/b": skill(5, 1)}),
            "Mean return 2.00 over one episode: too few to judge; every skill is used.",
        ),
    ],
)  # fmt: skip
def test_the_verdict_is_one_sentence_of_the_data(score, says):
    assert verdict(score, True) == says
    assert verdict(score, False) == f"With sampled actions: {says[0].lower()}{says[1:]}"


def test_without_episodes_the_verdict_says_how_far_training_is():
    stages = [stage_entry("one"), stage_entry("two", "training")]
    assert no_verdict(stages) == "Training is not finished: 1 of 2 stages are done."
    assert "No episodes were played" in no_verdict(stages[:1])


class Tells(Walkway):
    """Says whether an episode succeeded."""

    def step(self, action: int) -> Any:
        obs, reward, terminated, truncated, _ = super().step(action)
        return obs, reward, terminated, truncated, {"success": terminated}


def test_an_evaluation_counts_what_the_environment_calls_success(tmp_path):
    run = declare(Tells).train(tmp_path / "run", quiet=True)
    found = run.evaluate(4)
    assert (found.succeeded, found.to_json()["success_rate"]) == (4, 1.0)
    assert "100% succeed" in str(found)
    assert run.evaluate(2, max_steps=3).succeeded == 0
    assert declare().train(tmp_path / "other", quiet=True).evaluate(2).succeeded is None


# Reflexes


def reflexed(tmp_path: Path) -> Run:
    hierarchy = Hierarchy(
        EnvSpec(Walkway, engine="sync"),
        [Go(), Stay()],
        selector=choose,
        reflexes=[
            Reflex(lambda obs: obs[:, 0] == 2, action=1, name="hurry"),
            Reflex(lambda obs: obs[:, 1] == 2, action=1, name="later"),
            Reflex(lambda obs: obs[:, 0] > 99, action=1, name="never"),
        ],
    )
    return hierarchy.train(tmp_path / "run", quiet=True)


def test_reflexes_are_counted_by_hand(tmp_path):
    # At metre 2, which is at step 2, two reflexes hold, and the last one acts: it walks on where it
    # would have stayed. So the episode has eight steps in place of nine, and "hurry" never acts.
    run = reflexed(tmp_path)
    found = run.evaluate(3)
    assert found.lengths == (8, 8, 8)
    assert found.reflexes == {"hurry": 0, "later": 3, "never": 0}
    assert "reflex later acted in 3 of 24 steps (12.5%)" in found.for_people()
    assert found.to_json()["reflexes"]["later"] == {"steps": 3, "share": 3 / 24}
    # A skill alone is overridden, too.
    assert run.evaluate(1, skill="go").reflexes["later"] == 1
    found = run.evaluate(2, save=True)
    assert run.info()["evaluation"]["reflexes"] == found.to_json()["reflexes"]


def test_reflexes_of_a_nested_hierarchy_have_paths_and_yield_to_those_above(
    tmp_path,
):
    inner = reflexed(tmp_path / "inner").as_skill("inner")
    outer = Hierarchy(
        EnvSpec(Walkway, engine="sync"),
        [inner, Stay()],
        selector=lambda obs: np.full(len(obs), "inner"),
        reflexes=[Reflex(lambda obs: obs[:, 1] == 2, action=1, name="mine")],
    )
    found = outer.train(tmp_path / "outer", quiet=True).evaluate(2)
    told = {"mine": 2, "inner/hurry": 0, "inner/later": 0, "inner/never": 0}
    assert found.reflexes == told


# Docstrings


class Explained(Skill):
    """Lands ``softly``,
    with both legs.

    A second paragraph.
    """


class Heir(Explained):
    pass


def test_docstrings_are_those_of_the_user():
    assert about(Explained()) == "Lands `softly`, with both legs."
    assert about(Heir()) == "Lands `softly`, with both legs."
    assert about(type("Bare", (Skill,), {})()) == ""


# Names of observations


def test_named_observations_name_axes_and_what_each_call_saw(tmp_path):
    log, names = played(tmp_path / "run"), ["metre", "time"]
    assert timelines.decision_data(log, names)["names"] == [*names, "step of the episode"]
    (shown,), _ = timelines.episode_data(log, None, names)
    assert shown["seen"] == [[0, 0], [2, 2], [2, 5], [4, 7]]
    assert list(timelines.seen(log.episodes[0].calls, names)) == names
    (shown,), _ = timelines.episode_data(log, None)
    assert "seen" not in shown
    assert told(shown["calls"]) == CALLS


def test_names_that_do_not_fit_are_said_and_not_used(tmp_path):
    obs = np.zeros((3, 2))
    assert timelines.names_misfit(obs, ["a", "b"]) is None
    says = timelines.names_misfit(obs, ["a"])
    assert says == "obs_names is not used: it has 1 names, and an observation 2 numbers."
    assert "no Dict" in str(timelines.names_misfit(obs, {"a": ["b", "c"]}))
    parts = np.zeros(3, [("place", "f4", (2,)), ("key", "i8")])
    assert timelines.names_misfit(parts, {"place": ["x", "y"], "key": ["has key"]}) is None
    assert "no such key" in str(timelines.names_misfit(parts, {"plaec": ["x", "y"]}))
    found = timelines.coordinates(parts, {"place": ["x", "y"]})
    assert list(found) == ["x", "y", 'obs["key"]']


class Named(Walkway):
    obs_names = ("metre", "time")


class Doubled(gym.ObservationWrapper):  # type: ignore[type-arg]
    obs_names = ("twice the metre", "twice the time")

    def observation(self, observation: Array) -> Array:
        return 2 * observation


def test_names_come_from_the_spec_the_environment_or_gymnasium():
    assert EnvSpec(Walkway).observation_names() is None
    assert EnvSpec(Named).observation_names() == ("metre", "time")
    assert EnvSpec(Named, wrappers=(Doubled,)).observation_names() == Doubled.obs_names
    assert EnvSpec(Named, obs_names=["a", "b"]).observation_names() == ["a", "b"]
    # Names make no other environment: hierarchies with and without them fit each other.
    assert EnvSpec(Named, obs_names=["a", "b"]) == EnvSpec(Named)
    names = EnvSpec("CartPole-v1").observation_names()
    assert names == ("cart position", "cart speed", "pole angle", "pole angular speed")
    for env_id in ("Acrobot-v1", "CartPole-v1", "MountainCar-v0", "Pendulum-v1"):
        space = gym.make(env_id).observation_space
        assert (len(GYMNASIUM[env_id.rpartition("-v")[0]]),) == space.shape
    pytest.importorskip("Box2D")
    assert gym.make("LunarLander-v3").observation_space.shape == (len(GYMNASIUM["LunarLander"]),)


# The page


def verdict_in(path: Path) -> str:
    found = re.search(r'id="verdict">(.*?)</p>', path.read_text())[1]
    return re.sub(r"</?code>", "`", found).replace("&#39;", "'")


def test_the_page_shows_all_that(tmp_path):
    pytest.importorskip("vl_convert")
    run = reflexed(tmp_path)
    told = run.report(tmp_path / "page.html", episodes=6, films=0)
    assert verdict_in(tmp_path / "page.html") == told["verdict"]
    assert told["verdict"].startswith("Mean return ")
    text = (tmp_path / "page.html").read_text()
    assert "Walks two metres." in text
    assert "Table of reflexes" in text
    assert "12 %" in text


def test_a_sampled_evaluation_does_not_change_the_report(tmp_path):
    pytest.importorskip("vl_convert")
    run = declare().train(tmp_path / "run", quiet=True)
    found = run.evaluate(9, save=True)
    before = run.report(tmp_path / "before.html", episodes=2, films=0)["verdict"]
    assert "9 episodes" in before
    other = Evaluation((-5.0,) * 20, (9,) * 20, None, found.skills)
    save_evaluation(RunDirectory.open(run.path), other, 0, deterministic=False)
    assert run.report(tmp_path / "after.html", episodes=2, films=0)["verdict"] == before
    told = run.report(tmp_path / "x.html", episodes=2, films=0, deterministic=False)["verdict"]
    assert told.startswith("With sampled actions: mean return −5")


def test_a_comparison_of_0_and_1_is_in_percent(tmp_path):
    pytest.importorskip("vl_convert")
    runs = []
    for seed, returns in enumerate(((1.0, 1.0, 0.0, 1.0), (1.0, 0.0, 1.0, 0.0))):
        run = declare().train(tmp_path / f"s{seed}", seed=seed, quiet=True)
        runs.append(RunDirectory.open(run.path))
        save_evaluation(runs[-1], scored(list(returns)), 0, deterministic=True)
    write_comparison(runs, tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert "<dd>62 %</dd>" in text
    assert "episodes solved of a run" in text
