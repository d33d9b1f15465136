"""Skills and selector that learn together: whole runs, stopped and resumed, and what is kept."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from declaring import Other, declare
from small_runs import (
    MEMORY,
    OFF,
    ON,
    SMALL,
    Balance,
    Left,
    Push,
    Whole,
    assert_same,
    lines,
    messages,
    new_run,
    policies,
    reports_every,
    stage_entry,
)

from skillweave import SAC, EnvSpec, Lengths, Skill, SkillweaveError, Together
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.api.applying import differences
from skillweave.evolution import Evolution, Mutations
from skillweave.hierarchy import select_best, training
from skillweave.runs.comparison import SAMPLING
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import Checkpoint
from skillweave.schema import as_json
from skillweave.training import agents
from skillweave.training.episodes import Episodes
from skillweave.training.skill_report import SkillReport
from skillweave.training.stage_log import StageLog, success_rate

CALLED = {"left": SkillReport(3, 3, {}, None, None), "push": SkillReport(9, 1, {}, None, None)}


def played_as(monkeypatch, returns_of):
    """Let evaluations have the returns that a function says of the skills of a policy."""

    def played(policy, spec, *, engine, **how):
        assert engine == spec.engine, "they are played where it was trained"
        returns = returns_of(policy.skills)
        mean = float(np.mean(returns))
        return SimpleNamespace(mean=mean, returns=returns, lengths=(7, 8), skills=CALLED)

    monkeypatch.setattr(select_best, "evaluate", played)


def alternately(obs):
    return np.where(obs[:, 0] > 0, "left", "push")


class Remembers(Left):
    """Learns with a memory."""

    algorithm = MEMORY


KINDS = {
    "all": lambda: declare(
        call_steps=Lengths(1, ..., 8), interrupt=True, together=Together(task_weight=0.5)
    ),
    "mixed": lambda: declare(Left(), Other(), Push()),
    "memory": lambda: declare(Remembers(), Balance(), together=Together(task_weight=0.5)),
    "a selector with a memory": lambda: declare(
        Left(), Balance(), selector=Remembers.algorithm, interrupt=True
    ),
    "replay then": lambda: declare(Left(), Other(), learn="apart, then together"),
    "off-policy selector": lambda: declare(Left(), Balance(), selector=OFF),
    "then": lambda: declare(
        learn="apart, then together",
        together=Together(reference_kl=0.001, task_weight=0.0),
        greedy_skills=True,
    ),
    "interrupt apart": lambda: declare(learn="apart", interrupt=True, selector_steps=450),
}


often = reports_every(75)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return Whole(KINDS, tmp_path_factory)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("kind", KINDS)
def test_a_run_stopped_at_a_tick_ends_as_if_it_had_not_been(tmp_path, whole, kind):
    whole.assert_resumes(kind, (2, 4, 2), tmp_path / "run")


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("kind", KINDS)
def test_what_a_run_learnt_is_loaded_and_written_to_one_file(tmp_path, whole, kind):
    whole.assert_loads(kind, tmp_path / "weights")


def test_all_who_learn_change_and_all_who_are_ready_stay(whole):
    _, path = whole("all")
    names = {"selector", "left", "balance", "skill_critic"}
    assert {p.split(".")[1] for p in policies(path)} == names
    told = [name for line in lines(path) for name in line]
    for name in ("selector", "left", "balance"):
        assert f"{name}.samples" in told
    (entry,) = RunDirectory.open(path).manifest.stages
    assert entry.learns == ["selector", "left", "balance", "skill_critic"]
    assert 450 <= entry.steps <= 450 + 32, "a stage ends within one rollout of its budget"


@pytest.mark.slow
def test_two_workers_are_as_two_collectors_in_this_thread(tmp_path, monkeypatch):
    declare(workers=2).train(tmp_path / "processes", seed=3, quiet=True)
    from skillweave.experience import group
    from skillweave.workers import placement

    def here(make, num_envs, workers, members, name):
        each = num_envs // workers
        return group.Collectors([make(each, i * each) for i in range(workers)], members)

    places = placement.Placement(here, placement.LOCAL.workers)
    monkeypatch.setattr("skillweave.api.running.LOCAL", places)
    declare(workers=2).train(tmp_path / "here", seed=3, quiet=True)
    assert_same(tmp_path / "processes", tmp_path / "here")


@pytest.mark.slow
def test_learners_with_the_same_settings_share_an_algorithm_and_learn_as_if_they_did_not(
    tmp_path, monkeypatch
):
    made = []

    def noted(config, *spaces):
        made.append(config)
        return make_algorithm(config, *spaces)

    monkeypatch.setattr(agents, "make_algorithm", noted)
    slow = replace(ON, learning_rate=1e-4)

    class Slow(Left):
        algorithm = slow

    def train(name):
        made.clear()
        hierarchy = declare(Left(), Balance(), Slow())
        hierarchy.train(tmp_path / name, seed=3, quiet=True)
        return [config.learning_rate for config in made]

    rates = [ON.learning_rate, slow.learning_rate]
    assert sorted(train("shared")) == sorted([*rates, ON.learning_rate]), "the selector's is apart"
    monkeypatch.setattr(agents.Agents, "_equal_algorithm", lambda *settings: None)
    assert len(train("apart")) == 4
    assert_same(tmp_path / "shared", tmp_path / "apart")


@pytest.mark.slow
def test_skills_that_grew_in_a_population_go_on_as_they_are(tmp_path):
    always = Mutations(none=0, hyperparameters=0, parameters=0, activation=0, architecture=1)
    grows = Evolution(population=4, generations=4, episodes=2, mutations=always)
    hierarchy = declare(
        Left(), Push(), learn="apart, then together", skill_steps=2_000, together_steps=300
    )
    run = hierarchy.train(tmp_path / "run", seed=3, quiet=True, evolve={"left": grows})
    assert len(run.evaluate(2).returns) == 2
    told = RunDirectory.open(tmp_path / "run")
    before, after = told.load_policy("left"), told.load_policy("together", "left")
    shapes = [{k: v.shape for k, v in p.weights.items()} for p in (before, after)]
    assert shapes[0] == shapes[1]
    assert before.algorithm.config.network != SMALL


def test_the_better_of_before_and_after_is_kept(whole):
    _, path = whole("then")
    told = as_json(RunDirectory.open(path).stage("together").kept)
    assert {"before", "greedy"} < set(told)
    assert told["kept"] in told
    names = {"selector", "left", "balance"}
    own = {f"{n}.safetensors" for n in names} | {f"together.{n}.safetensors" for n in names}
    assert set(policies(path)) == own, "nothing that was learnt is lost"
    assert "reference_kl" in " ".join(lines(path)[-1])


@pytest.mark.fast_cases(1)
@pytest.mark.usefixtures("usual_episodes")
@pytest.mark.parametrize(
    ("learn", "asked", "played"),
    [
        ("together", None, {"greedy", "skills_sample"}),
        ("together", True, set()),
        ("together", False, set()),
        ("apart, then together", None, {"before", "greedy", "skills_sample"}),
        ("apart, then together", False, {"before", "greedy"}),
        ("apart", None, None),
    ],
)
def test_whether_skills_are_greedy_is_found_out_where_nobody_says_it(
    tmp_path, learn, asked, played
):
    hierarchy = declare(learn=learn, greedy_skills=asked, greedy_selector=True)
    run = hierarchy.train(tmp_path / "run", seed=3, quiet=True)
    assert hierarchy.selection.greedy_skills is asked, "another seed is judged anew"
    loaded = declare(learn=learn).load(run.path)
    run.save_weights(tmp_path / "weights")
    read = declare(learn=learn).load_weights(tmp_path / "weights")
    greedy = {r.policy.skills.greedy for r in (run, loaded, read)}
    if not played:
        assert greedy == {asked is not False}
        return
    kept = as_json(RunDirectory.open(run.path).stage("together").kept)
    best = kept.pop("kept")
    assert kept.pop("episodes") == 100
    assert set(kept) == played
    assert kept[best] == max(kept.values())
    assert greedy == {asked is None and best != "skills_sample"}
    assert run.evaluate(100, seed=select_best.SEEDS + 3).mean == kept[best]


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(("better", "engine"), [(True, "auto"), (False, "sync")])
def test_of_greedy_skills_and_ones_that_sample_the_better_are_kept(
    tmp_path, monkeypatch, better, engine
):
    """Not by chance: one of them always plays well here."""
    played_as(monkeypatch, lambda skills: (10.0 if skills.greedy is better else 5.0,) * 2)
    hierarchy = declare(env=EnvSpec("CartPole-v1", engine=engine), greedy_selector=True)
    said = messages(hierarchy, tmp_path / "run")
    assert hierarchy.load(tmp_path / "run").policy.skills.greedy is better
    assert RunDirectory.open(tmp_path / "run").stage("together").evaluation_steps == 30
    returns = (10.0, 5.0) if better else (5.0, 10.0)
    words = "greedy {:.4g}, with skills that sample {:.4g} (4 episodes each); kept: "
    compared = next(i for i, text in enumerate(said) if "playing 4 episodes of each" in text)
    assert words.format(*returns) in said[compared + 1]


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(
    ("means", "kept"),
    [
        ({"greedy": 5.0, "selector_samples": 10.0}, "selector_samples"),
        ({"greedy": 5.0, "selector_samples": 5.1}, "greedy"),  # not clearly better
        ({"skills_sample": 7.0, "selector_samples": 10.0, "both_sample": 9.9}, "selector_samples"),
        # Under a greedy selector that is stuck, greedy skills and sampling ones are worth the same.
        ({"both_sample": 10.0}, "both_sample"),
    ],
)
def test_a_selector_samples_where_that_is_clearly_better(tmp_path, monkeypatch, means, kept):
    """A greedy selector can call one skill forever, where a sampling one solves the task."""

    def returns_of(skills):
        kind = (not skills.greedy, not skills.greedy_selector)
        mean = means.get(next(name for name, flags in SAMPLING.items() if flags == kind), 0.0)
        return (mean - 1.0, mean + 1.0) * 20

    played_as(monkeypatch, returns_of)
    run = declare().train(tmp_path / "run", quiet=True)
    entry = RunDirectory.open(run.path).stage("together")
    assert entry.kept.kept == kept
    weights = run.save_weights(tmp_path / "weights")
    for found in (run, declare().load(run.path), declare().load_weights(weights)):
        policy = found.policy
        samples = (not policy.skills.greedy, not policy.skills.greedy_selector)
        assert samples == SAMPLING[kept]


@pytest.mark.parametrize(
    ("exploring", "error", "learns", "is_said"),
    [
        (0.33, 0.04, True, True),
        (0.33, 0.04, False, False),  # nothing is chosen at random
        (0.22, 0.02, True, False),  # by chance
        (0.20, 0.00, True, False),
        (None, None, True, False),  # no episode has ended
    ],
)
def test_a_selector_that_was_better_with_exploration_is_named(
    tmp_path, monkeypatch, exploring, error, learns, is_said
):
    """Returns of 0 and 1, of which a fifth are 1 without exploration: an error of 0.04."""

    known = {} if exploring is None else {"return": exploring, "return_error": error}
    monkeypatch.setattr(Episodes, "summary", lambda self: {"length": 7.0} | known)
    played_as(monkeypatch, lambda skills: (0, 0, 0, 0, 1) * 20)
    hierarchy = declare() if learns else declare(selector=alternately)
    heard = messages(hierarchy, tmp_path / "run")
    said = ["'left' in 75% of its" in text for text in heard if "chosen at random" in text]
    assert said == [True] * is_said


@pytest.mark.parametrize(
    ("steps", "length", "episodes"),
    [
        (1_000_000, 200.0, 100),
        (100_000, 200.0, 50),
        (100_000, 500.0, 20),
        (100_000, 600.0, 8),  # 5 candidates of 8 episodes are 24 % of the steps
        (100_000, 1_100.0, 0),  # fewer than five
        (500, None, 0),
    ],
)
def test_fewer_episodes_are_played_where_they_are_long(monkeypatch, steps, length, episodes):
    monkeypatch.setattr(select_best, "MOST", 100)
    monkeypatch.setattr(select_best, "SHORT_SHARE", 0.05)
    entry = stage_entry("together", steps=steps, final={"length": length})
    assert select_best._episodes(entry) == episodes


def test_a_training_too_short_for_a_comparison_plays_no_episodes(tmp_path, monkeypatch):
    monkeypatch.setattr(select_best, "SHORT_SHARE", 0.05)
    run = declare(learn="apart, then together").train(tmp_path / "run", quiet=True)
    entry = run.info()["stages"][-1]
    assert entry["kept"] == {"kept": "skills_sample"}
    assert entry["evaluation_steps"] == 0
    skills = declare().load(run.path).policy.skills
    assert (skills.greedy, skills.greedy_selector) == (False, True)


def test_a_sampling_selector_samples_also_where_greedy_actions_are_asked(tmp_path):
    run = declare(greedy_selector=False, greedy_skills=True).train(tmp_path / "run", quiet=True)
    policy, obs = run.policy, np.zeros((200, 4), np.float32)
    rng = np.random.default_rng(0)
    _, memory = policy.act(policy.start(200), obs, deterministic=True, rng=rng)
    assert len(set(memory["skill"].tolist())) > 1, "the selector is nearly uniform so early"


@pytest.mark.parametrize(("learn", "said"), [("apart", True), ("together", None)])
def test_a_run_says_what_nobody_said_where_it_makes_a_difference(tmp_path, learn, said):
    """Nothing differs from what was left open."""
    run = new_run(declare(learn=learn), tmp_path / "run")
    level = run.manifest.hierarchy
    assert level is not None
    assert level.greedy_skills is said
    run.manifest.hierarchy = replace(level, greedy_skills=True)
    seed = run.manifest.seed
    assert differences(training.manifest(declare(learn=learn), seed=seed), run) == ""
    other = declare(learn=learn, greedy_skills=False)
    told = differences(training.manifest(other, seed=seed), run)
    assert "greedy_skills is yes (declared now: no)" in told
    run.close()


def test_the_critic_learns_as_the_selector_decides_and_what_deciding_is_worth_where_calls_are_cut():
    for learn in ("together", "apart", "apart, then together"):
        *_, stage = declare(learn=learn, interrupt=True).stages()
        assert stage.beside["skill_critic"].deciding
    (stage,) = declare(together=Together(task_weight=0.5)).stages()
    assert not stage.beside["skill_critic"].deciding
    selector = replace(ON, min_advantage_std=7.0)
    (stage,) = declare(interrupt=True, selector=selector).stages()
    assert stage.beside["skill_critic"].min_advantage_std == 7.0
    for how in ({}, {"selector": replace(ON, epsilon=0.7)}):
        told = Together(epsilon_fraction=0.3, task_weight=0.0)
        (stage,) = declare(interrupt=True, together=told, **how).stages()
        critic = stage.beside["skill_critic"]
        for name in ("epsilon", "epsilon_final", "epsilon_fraction"):
            assert getattr(critic, name) == getattr(stage.config, name)
        assert (critic.epsilon, critic.epsilon_fraction) == ((0.7, 1.0) if how else (1.0, 0.3))


@pytest.mark.parametrize("name", ["epsilon_final", "epsilon_fraction"])
def test_how_a_selectors_floor_falls_is_not_lost_where_it_has_none(name):
    alone = declare(selector=replace(ON, **{name: 0.5}))
    with pytest.raises(SkillweaveError, match=rf"set together\.{name}, or selector\.epsilon, too"):
        alone.stages()
    (stage,) = declare(selector=replace(ON, epsilon=0.7, **{name: 0.5})).stages()
    assert getattr(stage.config, name) == 0.5
    assert stage.config.epsilon == 0.7
    declare(learn="apart", selector=replace(ON, **{name: 0.5})).stages()


class Never(Left):
    """Says of no call that it succeeded."""

    def success(self, step):
        return np.zeros(len(step.reward), bool)


class Always(Left):
    """Says so of all."""

    def success(self, step):
        return np.ones(len(step.reward), bool)


def test_a_skill_that_never_succeeded_is_told_and_moves_freely_afterwards(tmp_path):
    hierarchy = declare(Never(), Always(), learn="apart, then together")
    said = [text for text in messages(hierarchy, tmp_path / "run") if "succe" in text]
    assert [text.partition(":")[0] for text in said[:2]] == ["never", "together"]
    assert all("'never' ended with success() true" in text for text in said[2:])
    assert "no call ended with success() true" in said[0]
    assert "skill 'never' did not succeed any more" in said[1]
    told = lines(tmp_path / "run")[-1]
    assert "always.reference_kl" in told
    assert "never.reference_kl" not in told


@pytest.fixture
def skill_log(tmp_path):
    """A new run, and the log of its first skill."""
    run = new_run(declare(Left(), Balance(), learn="apart"), tmp_path / "run")
    with closing(run):
        yield run, StageLog("left", run, (), Checkpoint.start("left"))


@pytest.mark.parametrize(
    ("told", "succeeded", "rate"),
    [
        ([{}, {}], None, 1.0),
        ([{"success": 0.0}, {"success": 0.0}], False, 0.0),
        ([{"success": 0.1}, {"success": 0.0}], True, 0.0),
        ([{"success": 0.0}, {"success": 0.25}], True, 0.25),
        ([{"success": 0.0}, {"success": 0.25, "eval_success": 1.0}], True, 1.0),
    ],
)
def test_success_is_judged_by_all_calls_of_a_stage_and_its_rate_by_the_last(
    skill_log, told, succeeded, rate
):
    run, log = skill_log
    for update, metrics in enumerate(told):
        log.tick(update, 64 * (update + 1), 0.1, metrics)
    for other in (1.0, True, None):  # lines that name no stage
        run.log({"success": other})
    log.done({}, {})
    entry = RunDirectory.open(run.path).stage("left")
    assert entry.succeeded is succeeded
    assert success_rate(entry) == rate


def test_words_instead_of_a_rate_of_success_are_refused(skill_log):
    run, log = skill_log
    run.log({"stage": "left", "success": "often"})
    with pytest.raises(SkillweaveError, match=r"metrics\.jsonl: 'left' has .* 'often', .* resume"):
        log.done({}, {})


class Right(Skill):
    """The reward of the task, so that it is learnt by a flat agent as well."""


@pytest.mark.slow
def test_with_one_skill_and_calls_of_one_step_no_trajectory_is_torn(tmp_path):
    """What a flat agent would learn from: the value of a state is that of its episode."""
    alone = declare(
        Right(), call_steps=1, together_steps=3_000, together=Together(epsilon=0.0, task_weight=0.0)
    )
    path = tmp_path / "run"
    alone.train(path, seed=0, quiet=True)
    found = lines(path)[-1]
    assert found["right.samples"] == 32
    assert (found["right.usage"], found["selector.call_length"]) == (1.0, 1.0)
    assert found["length"] > 15


def test_who_would_never_learn_and_who_cannot_evolve_is_told_before_a_run_is_begun(tmp_path):
    with pytest.raises(SkillweaveError, match="budget is 15 steps, but 'other' begins to learn"):
        declare(Left(), Other(), together_steps=15).train(tmp_path / "run", quiet=True)
    last = declare(learn="apart, then together")
    with pytest.raises(SkillweaveError, match="stage 'together': selector and left"):
        last.train(tmp_path / "run", quiet=True, evolve=Evolution(population=2))
    assert not (tmp_path / "run").exists()


def test_lengths_double_where_dots_stand():
    assert Lengths(1, ..., 16).steps == (1, 2, 4, 8, 16)
    assert Lengths(3, ..., 10, 40).steps == (3, 6, 10, 40)
    assert repr(Lengths(1, 4)) == "Lengths(1, 4)"


def test_a_stage_ends_early_at_its_target(tmp_path):
    hierarchy = declare(eval_every=200, eval_episodes=2, target_return=5.0, together_steps=10_000)
    path = tmp_path / "run"
    hierarchy.train(path, seed=0, quiet=True)
    (entry,) = RunDirectory.open(path).manifest.stages
    assert entry.reached.value >= 5.0
    assert 200 <= entry.steps < 500
    assert entry.evaluation_steps > 10


def test_what_cannot_evolve_together_learns_apart_and_says_so_once(tmp_path, capsys):
    how = {"skill_steps": 100, "selector_steps": 100}
    hierarchy = declare(Left(), Push(), **how)
    evolve = {"left": Evolution(population=2, generations=1, episodes=1)}
    run = hierarchy.train(tmp_path / "run", evolve=evolve)
    said = capsys.readouterr().err.replace("\n", " ")
    assert said.count("cannot evolve together yet, so they learn apart") == 1
    assert [s["name"] for s in run.info()["stages"]] == ["left", "selector"]
    assert hierarchy.learn == "together", "the declaration stays as it was"
    assert len(hierarchy.load(run.path).evaluate(2).returns) == 2


@pytest.mark.slow
def test_continuous_skills_of_several_algorithms_learn_together(tmp_path):
    class Slow(Skill):
        algorithm = SAC(
            num_envs=4, learning_starts=40, batch_size=16, buffer_size=2_000, train_freq=16,
            network=SMALL,
        )  # fmt: skip

        def reward(self, step):
            return -np.abs(step.next_obs[:, 2])

    hierarchy = declare(
        Slow(), Right(), env=EnvSpec("Pendulum-v1", engine="sync"), call_steps=5,
        together_steps=600,
    )  # fmt: skip
    run = hierarchy.train(tmp_path / "run", seed=0, quiet=True)
    told = lines(tmp_path / "run")[-1]
    assert "slow.policy_loss" in told or "slow.critic_loss" in told
    assert "right.kl" in told
    assert isinstance(run.policy.action_space, gym.spaces.Box)
