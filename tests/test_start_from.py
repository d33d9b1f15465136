"""A run that begins with what was learnt in another one."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import partial

import pytest
import torch
from declaring import declare as small
from small_runs import MEMORY, OFF, ON, SMALL, Left, Push, Stopped, assert_same, stop_at

from skillweave import PPO, SAC, Agent, Network, Skill, SkillweaveError, Together
from skillweave.algorithms import SelfImitationPPO
from skillweave.cli import main
from skillweave.errors import RunError
from skillweave.evolution import Evolution
from skillweave.experience.acting import Acting
from skillweave.hierarchy import training
from skillweave.runs import directory
from skillweave.runs.directory import RunDirectory
from skillweave.runs.files import read_tensors, write_tensors
from skillweave.runs.initial_policies import (
    copy_initial_policies,
    learners_of_run,
    record_initial_policies,
)
from skillweave.runs.manifest import settings_of
from skillweave.training.joint import JointLearner

STILL = 1e-12
"""A learning rate by which nothing moves."""
AGENTS = {
    "PPO": ON,
    "recurrent PPO": MEMORY,
    "self-imitation": SelfImitationPPO(**vars(ON), imitation_rows=50),
    "DQN": OFF,
    "SAC": SAC(num_envs=4, batch_size=16, learning_starts=40, buffer_size=2_000, network=SMALL),
}


class Other(Skill):
    """Balances."""

    max_steps = 20
    algorithm = OFF

    def reward(self, step):
        return 1.0 - abs(step.next_obs[:, 2])


def declare(learn="apart", rate=None, skills=(Left, Other, Push), **how):
    settings = {
        "env": "CartPole-v1", "call_steps": 5, "skill_steps": 300, "selector_steps": 300,
        "together_steps": 600, "checkpoint_every": 100, "greedy_skills": False,
    }  # fmt: skip
    found = small(*(skill() for skill in skills), **settings | how | {"learn": learn})
    if rate is not None:
        found.algorithm = replace(found.algorithm, learning_rate=rate)
        for who, name in ((found, "selector"), *((s, "algorithm") for s in found.skills)):
            if (own := getattr(who, name)) is not None and not callable(own):
                setattr(who, name, replace(own, learning_rate=rate))
    return found


def train(path, start, learn="apart", rate=None, seed=6, **how):
    """Train the hierarchy in a new run that starts from others."""
    return declare(learn, rate, **how).train(path, seed=seed, quiet=True, start_from=start)


def weights_of(path):
    """By name, the weights of all who have learnt in a run, without the scaling of observations."""
    return {
        name: {k: v for k, v in own.policy.weights.items() if not k.startswith("obs_")}
        for name, own in learners_of_run(path).items()
    }


def manifest_of(path):
    return RunDirectory.open(path).manifest


def assert_near(found, wanted):
    assert found.keys() == wanted.keys()
    for name, weight in wanted.items():
        torch.testing.assert_close(found[name], weight, atol=1e-6, rtol=0)


def differ(one, other):
    return any(not torch.allclose(one[k], other[k], atol=1e-3) for k in one)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A run in which two skills and a selector have learnt."""
    path = tmp_path_factory.mktemp("source") / "run"
    declare().train(path, seed=5, quiet=True)
    return path


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("kind", AGENTS)
def test_a_plain_agent_begins_with_the_weights_it_ended_with(kind, tmp_path):
    config = AGENTS[kind]
    first = Agent("CartPole-v1", config, 400).train(tmp_path / "first", seed=1, quiet=True)
    still = Agent("CartPole-v1", replace(config, learning_rate=STILL), 200)
    for start in (first, str(first.path)):
        path = tmp_path / f"second-{type(start).__name__}"
        still.train(path, seed=2, quiet=True, start_from=start)
        assert_near(weights_of(path)["agent"], weights_of(first.path)["agent"])
    fresh = still.train(tmp_path / "fresh", seed=2, quiet=True)
    assert differ(weights_of(fresh.path)["agent"], weights_of(first.path)["agent"])


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("learn", ["apart", "together", "apart, then together"])
def test_all_who_have_learnt_there_begin_with_it(learn, source, tmp_path):
    path = tmp_path / "run"
    train(path, source, learn, STILL, together=Together(reference_kl=None, task_weight=0.0))
    before, after = weights_of(source), weights_of(path)
    assert set(before) == set(after) == {"left", "other", "selector"}
    for name, wanted in before.items():
        assert_near(after[name], wanted)


@pytest.mark.slow
def test_what_was_learnt_together_is_a_start_too_with_its_critic(tmp_path):
    how = {"interrupt": True, "together_steps": 600}
    declare("together", **how).train(tmp_path / "a", seed=1, quiet=True)
    train(tmp_path / "b", tmp_path / "a", "together", STILL, seed=2, **how)
    before, after = weights_of(tmp_path / "a"), weights_of(tmp_path / "b")
    assert set(before) == {"left", "other", "selector", "skill_critic"}
    for name in ("left", "other", "selector"):
        assert_near(after[name], before[name])
    assert "skill_critic" in manifest_of(tmp_path / "b").stages[0].starts


def test_who_has_not_learnt_there_begins_afresh_and_people_are_told(source, tmp_path, capsys):
    class Third(Left):
        """Another one."""

    small = declare(rate=STILL, skills=(Left, Third), selector=lambda obs: obs[:, 2] > 0)
    small.train(tmp_path / "run", seed=6, start_from=source)
    assert f"start from {source}: left" in " ".join(capsys.readouterr().err.split())
    alone = small.train(tmp_path / "alone", seed=6, quiet=True)
    after, fresh = weights_of(tmp_path / "run"), weights_of(alone.path)
    assert_near(after["left"], weights_of(source)["left"])
    assert_near(after["third"], fresh["third"])
    starts = {s["name"]: s.get("starts") for s in alone.info()["stages"]}
    assert starts == {"left": None, "third": None}
    assert alone.info()["id"] != manifest_of(tmp_path / "run").id, "they are two runs"


@pytest.mark.slow
def test_the_scaling_of_observations_counts_for_as_much_as_was_seen(source, tmp_path):
    moments = {
        k: v for k, v in learners_of_run(source)["left"].policy.weights.items() if "obs_" in k
    }
    assert set(moments) == {"obs_mean", "obs_var", "obs_low", "obs_high", "obs_count"}
    run = train(tmp_path / "run", source)
    (told,) = [s["starts"] for s in run.info()["stages"] if s["name"] == "left"]
    assert told["left"]["steps"] == 320  # of the source's stage: ten rollouts
    config = PPO(num_envs=4, n_steps=16, network=SMALL, learning_rate=STILL)
    Agent("CartPole-v1", config, 6_400).train(tmp_path / "a", quiet=True)
    Agent("CartPole-v1", config, 64).train(tmp_path / "b", quiet=True, start_from=tmp_path / "a")
    a, b = (learners_of_run(tmp_path / k)["agent"].policy.weights["obs_var"] for k in "ab")
    assert ((a - b).abs() <= 0.03 * a).all(), "64 steps move what 6,400 have found by a hundredth"


@pytest.mark.slow
def test_a_dqn_begins_neither_at_random_nor_to_explore_anew(tmp_path, monkeypatch):
    config = replace(OFF, learning_starts=200)
    at_random, epsilon, begin = [], [], Acting.begin

    def told(self, request, *more):
        at_random.append(request.at_random)
        epsilon.extend(p.extra["epsilon"].item() for p in request.params if "epsilon" in p.extra)
        begin(self, request, *more)

    monkeypatch.setattr(Acting, "begin", told)
    Agent("CartPole-v1", config, 400).train(tmp_path / "a", quiet=True)
    assert any(at_random)
    assert (epsilon[0], epsilon[-1]) == pytest.approx((1.0, OFF.exploration_final_eps))
    at_random.clear()
    epsilon.clear()
    Agent("CartPole-v1", config, 400).train(tmp_path / "b", quiet=True, start_from=tmp_path / "a")
    assert at_random
    assert not any(at_random)
    assert epsilon == pytest.approx([OFF.exploration_final_eps] * len(epsilon))


@pytest.mark.slow
def test_who_starts_from_a_run_is_not_held_near_what_it_was(source, tmp_path, monkeypatch):
    anchors, make = {}, JointLearner.__init__

    def made(self, parts, *more):
        anchors.update({name: getattr(part, "reference", None) for name, part in parts.items()})
        make(self, parts, *more)

    monkeypatch.setattr(JointLearner, "__init__", made)
    train(tmp_path / "a", source, "together")
    assert set(anchors.values()) == {None}
    # What an earlier stage of the same run taught is an anchor, as ever.
    train(tmp_path / "b", source, "apart, then together")
    assert anchors["left"] is not None


def test_where_nothing_can_be_copied_no_run_is_begun(source, tmp_path, monkeypatch):
    write = directory.write_tensors

    def full(path, *about, **how):
        if "other" in path.name:
            raise RunError("No space left on device")
        return write(path, *about, **how)

    monkeypatch.setattr(directory, "write_tensors", full)
    with pytest.raises(SkillweaveError, match="No space left"):
        train(tmp_path / "run", source)
    monkeypatch.undo()
    begun(tmp_path / "run", source).close()


@pytest.mark.slow
def test_seeds_that_start_from_runs_of_their_own_are_one_group(tmp_path):
    agent = Agent("CartPole-v1", ON, 64)
    found = []
    for seed in range(2):
        first = agent.train(tmp_path / f"first-{seed}", seed=seed, quiet=True)
        run = agent.train(tmp_path / f"then-{seed}", seed=seed, quiet=True, start_from=first)
        found.append(settings_of(manifest_of(run.path)))
    assert found[0] == found[1]
    assert found[0] != settings_of(manifest_of(first.path))


@pytest.mark.slow
def test_what_is_left_of_a_start_goes_with_the_next_training(source, tmp_path, monkeypatch):
    """Killed between the end of a stage and the removal of what it began with."""
    run = begun(tmp_path / "run", source)
    monkeypatch.setattr(RunDirectory, "drop_used", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        training.train(declare(), run)
    run.close()
    monkeypatch.undo()
    assert (run.path / "starts/left.safetensors").exists()
    declare().resume(run.path, quiet=True)
    assert not (run.path / "starts").exists()


def begun(path, source, **how):
    """A run that starts from another one, not trained yet."""
    hierarchy, learnt = declare(**how), learners_of_run(source)
    content = training.manifest(hierarchy, seed=3, flat=False)
    record_initial_policies(content.stages, learnt, source)
    return RunDirectory.create(path, content, partial(copy_initial_policies, learnt=learnt))


@pytest.mark.slow
@pytest.mark.parametrize("learn", ["apart", "together"])
def test_a_run_that_is_killed_needs_the_other_one_no_more(learn, source, tmp_path):
    """Also where it is killed before its first checkpoint."""
    copy = tmp_path / "source"
    shutil.copytree(source, copy)
    for name in ("killed", "whole"):
        begun(tmp_path / name, copy, learn=learn).close()
    declare(learn).resume(tmp_path / "whole", quiet=True)
    shutil.rmtree(copy)
    declare(learn).resume(tmp_path / "killed", quiet=True)
    assert_same(tmp_path / "killed", tmp_path / "whole")
    assert not (tmp_path / "killed/starts").exists(), "what is done needs no start"


def test_a_copy_that_is_lost_or_anothers_is_refused(source, tmp_path):
    run = begun(tmp_path / "run", source)
    run.close()
    file = tmp_path / "run/starts/left.safetensors"
    kept = file.read_bytes()

    def double():  # with a right checksum
        tensors, header = read_tensors(file)
        write_tensors(file, {k: 2 * v for k, v in tensors.items()}, header)

    for damage, says in (
        (file.unlink, r"left\.safetensors is missing.*train again"),
        (
            lambda: shutil.copy(file.with_name("other.safetensors"), file),
            "does not hold the initial policy of 'left'",
        ),
        (lambda: shutil.copy(source / "policies/left.safetensors", file), "belongs to another run"),
        (lambda: file.write_bytes(kept[:-8] + bytes(8)), "damaged"),
        (double, "not the file that the run wrote there"),
    ):
        damage()
        with pytest.raises(SkillweaveError, match=says):
            declare().resume(run.path, quiet=True)
        file.write_bytes(kept)
    declare().resume(run.path, quiet=True)


WRONG = {
    "nowhere": ({}, "nowhere", r"nowhere holds no run"),
    "a number": ({}, 5, r"start_from is 5"),
    "nobody": (
        {"skills": (type("Third", (Left,), {}), Push), "selector": lambda obs: obs[:, 2] > 0},
        None,
        r"no learner of this run has learnt in .*: this run trains third, and that one has left",
    ),
    "network": (
        {"algorithm": replace(ON, network=Network((9,)))},
        None,
        r"'left' cannot start with what it learnt in .*it has other networks here",
    ),
    "another order": (
        {"skills": (Other, Left, Push)},
        None,
        r"'selector'.*chooses from left, other, push, and here from other, left, push",
    ),
    "another environment": (
        {"env": "Acrobot-v1", "skills": (Left, Other)},
        None,
        r"'left'.*its observations are others here",
    ),
    "algorithm": ({"selector": OFF}, None, r"'selector'.*by PPO there.* by DQN here"),
    "fewer skills": ({"skills": (Left, Other)}, None, r"'selector'.*here from left, other$"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_is_said_before_anything_is_written(case, source, tmp_path):
    how, start, says = WRONG[case]
    if start == "nowhere":
        start = tmp_path / start
    with pytest.raises(SkillweaveError, match=says):
        train(tmp_path / "run", start or source, **how)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_run_that_is_not_finished_gives_what_it_has(source, tmp_path):
    path = tmp_path / "unfinished"
    with pytest.raises(Stopped):
        declare().train(path, quiet=True, callback=stop_at(1, "other"))
    assert set(learners_of_run(path)) == {"left"}
    train(tmp_path / "run", path, rate=STILL)
    assert_near(weights_of(tmp_path / "run")["left"], weights_of(path)["left"])


@pytest.fixture(scope="module")
def other_runs(tmp_path_factory):
    """A second run of the same skills, and one of a plain agent."""
    folder = tmp_path_factory.mktemp("others")
    declare().train(folder / "second", seed=8, quiet=True)
    Agent("CartPole-v1", ON, 300).train(folder / "plain", seed=9, quiet=True)
    return folder / "second", folder / "plain"


@pytest.mark.slow
@pytest.mark.parametrize("learn", ["apart", "together"])
def test_several_runs_are_a_start_by_the_name_of_who_begins(learn, source, other_runs, tmp_path):
    second, plain = other_runs
    start = {"other": second, "left": str(plain), "selector": source}
    how = {"together": Together(reference_kl=None, task_weight=0.0)}
    train(tmp_path / "run", start, learn, STILL, **how)
    after = weights_of(tmp_path / "run")
    assert_near(after["other"], weights_of(second)["other"])
    assert_near(after["left"], weights_of(plain)["agent"])
    assert_near(after["selector"], weights_of(source)["selector"])
    stages = manifest_of(tmp_path / "run").stages
    runs = {name: start.run for stage in stages for name, start in stage.starts.items()}
    places = {"other": second, "left": plain, "selector": source}
    assert runs == {name: manifest_of(path).id for name, path in places.items()}


def test_what_is_wrong_with_several_runs_is_a_sentence_and_populations_start_from_none(
    source, other_runs, tmp_path
):
    evolve = {"selector": Evolution(population=2, generations=2)}
    with pytest.raises(SkillweaveError, match=r"start_from: stage 'selector' evolves"):
        declare().train(tmp_path / "run", quiet=True, evolve=evolve, start_from=source)
    _, plain = other_runs
    for start, says in (
        ({}, r"start_from is \{\}; name the run of each"),
        ({"lefft": source}, r"names 'lefft', which does not learn here.*is 'left' meant"),
        ({"push": source}, r"names 'push', which does not learn here; there are: left, other"),
        ({"left": tmp_path / "no"}, "holds no run"),
        ({"left": 5}, r"start_from\['left'\] is 5; it must be a path"),
        ({"selector": plain}, r"'selector' cannot start with what it learnt in .*plain"),
    ):
        with pytest.raises(SkillweaveError, match=says):
            train(tmp_path / "run", start)
    assert not (tmp_path / "run").exists()
    train(tmp_path / "less", None, skills=(Left, Push))
    with pytest.raises(RunError, match=r"'other' has not learnt in .*; there learnt left, s"):
        train(tmp_path / "run", {"other": tmp_path / "less"})


def test_the_command_takes_one_run_or_several(source, other_runs, tmp_path, capsys):
    recipe = tmp_path / "cart.py"
    recipe.write_text("from test_start_from import declare\nhierarchy = declare(rate=1e-12)\n")

    def train_from(*runs, out="run"):
        words = [word for run in runs for word in ("--start-from", str(run))]
        to = ["--out", str(tmp_path / out), "--evaluate", "0"]
        return main(["train", str(recipe), *to, *words]), capsys.readouterr().err

    assert train_from(f"left={source}", f"other={other_runs[0]}")[0] == 0
    before, after = weights_of(source), weights_of(tmp_path / "run")
    assert_near(after["left"], before["left"])
    assert_near(after["other"], weights_of(other_runs[0])["other"])
    assert differ(after["selector"], before["selector"]), "who is not named begins afresh"
    code, said = train_from(source, out="second")
    assert (code, "start from" in said) == (0, True)
    assert_near(weights_of(tmp_path / "second")["selector"], before["selector"])
    assert main(["info", str(tmp_path / "second")]) == 0
    run = manifest_of(source).id
    assert f"left starts from run {run}, after 320 steps there" in capsys.readouterr().out
    for runs, says in (
        ((source, f"left={source}"), "name the learner of each"),
        ((f"left={source}", f"left={source}"), "names left twice"),
        ((tmp_path / "no",), "holds no run"),
    ):
        code, said = train_from(*runs, out="third")
        assert (code, says in said) == (1, True)


def nested(rate=None):
    inner = declare(rate=rate, skills=(Left, Other)).as_skill("inner")
    outer = declare(rate=rate, skills=(Other,), call_steps=8, skill_steps=600, selector_steps=600)
    outer.skills = (*outer.skills, inner)
    return outer


@pytest.mark.slow
def test_all_levels_of_a_nested_hierarchy_begin_with_what_they_learnt(tmp_path):
    nested().train(tmp_path / "a", seed=1, quiet=True)
    nested(STILL).train(tmp_path / "b", seed=2, quiet=True, start_from=tmp_path / "a")
    before, after = weights_of(tmp_path / "a"), weights_of(tmp_path / "b")
    assert set(before) == {"inner/left", "inner/other", "inner/selector", "other", "selector"}
    for name, wanted in before.items():
        assert_near(after[name], wanted)
    other = nested()
    inner = other.skills[1].policy
    inner.skills = inner.skills[::-1]
    with pytest.raises(SkillweaveError, match=r"'inner/selector'.*from left, other, and here from"):
        other.train(tmp_path / "c", quiet=True, start_from=tmp_path / "a")
