"""Hierarchies as skills of hierarchies: whole runs, stopped and resumed, and bad declarations."""

from __future__ import annotations

import shutil
from dataclasses import replace
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from declaring import declare as small
from playing import episode
from small_runs import (
    MEMORY,
    OFF,
    ON,
    Balance,
    Left,
    Push,
    Whole,
    lines,
    policies,
    reports_every,
    small_manifest,
    stage_entry,
    stopped_run,
)

from skillweave import (
    TD3,
    Automaton,
    EnvSpec,
    Hierarchy,
    Lengths,
    Reflex,
    Skill,
    SkillweaveError,
    Together,
)
from skillweave.calls.columns import ENDS
from skillweave.cli import main
from skillweave.hierarchy.roles import roles_of
from skillweave.hierarchy.select_best import resolve_greedy
from skillweave.runs.comparison import Comparison
from skillweave.runs.directory import RunDirectory
from skillweave.training.evaluation import episode_seeds, evaluate
from skillweave.training.played_calls import PlayedCalls, PlayedEpisodes

CARTPOLE = EnvSpec("CartPole-v1", engine="sync", workers=1)


class Right(Skill):
    """Moves to the right."""

    def reward(self, step):
        return step.next_obs[:, 0]


def inside(*skills, **how):
    skills = skills or (Balance(), Right())
    return small(*skills, **{"call_steps": 3, "name": "inner", "learn": "apart"} | how)


def declare(inner=None, **how):
    """Left, a hierarchy of balance and right, and a ready skill."""
    inner = inside() if inner is None else inner
    return small(Left(), inner, Push(), **{"call_steps": 7, "learn": "apart"} | how)


def test_selectors_and_critics_of_all_levels_have_the_settings_of_learning_together():
    told = Together(epsilon=0.8, epsilon_final=0.2, epsilon_fraction=0.3, task_weight=0.0)
    (stage,) = declare(learn="together", together=told).stages()
    for config in (stage.config, stage.beside["inner/selector"]):
        assert (config.epsilon, config.epsilon_final, config.epsilon_fraction) == (0.8, 0.2, 0.3)
    (stage,) = KINDS["interrupted"]().stages()
    critics = [c for k, c in stage.beside.items() if k.endswith("skill_critic")]
    assert [critic.deciding for critic in critics] == [True, True]


def test_budgets_of_all_levels_count_and_are_scaled():
    found = declare()
    assert found.total_steps == (150 + 150 + 150) + 150 + 150
    found.scale(2.0)
    assert found.total_steps == 1500
    together = declare(learn="together")
    assert together.total_steps == 450
    together.env = replace(together.spec, workers=2)  # the outermost says it
    together.check_spaces()


class Careful(Skill):
    """A hierarchy that is paid in its own way, and stops by itself."""

    max_steps = 9
    policy = None

    def reward(self, step):
        return 1.0 - np.abs(step.next_obs[:, 2])

    def termination(self, step):
        return np.abs(step.next_obs[:, 2]) > 0.1


def careful(**how):
    found = Careful()
    found.policy = inside(**how)
    return found


def three():
    """A hierarchy in a hierarchy in a hierarchy."""
    deepest = inside(Right(), Push(), call_steps=2, name="deepest")
    middle = inside(Balance(), deepest, call_steps=4, name="middle", interrupt=True)
    return small(Left(), middle, call_steps=7)


class InParts(gym.ObservationWrapper):
    """CartPole that shows cart and pole apart."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = gym.spaces.Dict(  # with a gap between the parts
            cart=gym.spaces.Box(-np.inf, np.inf, (1,), np.float32),
            pole=gym.spaces.Box(-np.inf, np.inf, (2,), np.float64),
            side=gym.spaces.Discrete(2, start=1),  # what nobody has seen yet is none of these
        )

    def observation(self, observation):
        side = 1 + int(observation[0] > 0)
        return {"cart": observation[:1], "pole": observation[2:].astype(np.float64), "side": side}


class LeansLeft(Skill):
    """Is paid for a pole that leans to the left."""

    def reward(self, step):
        return -step.next_obs["pole"][:, 0]


class LeansRight(Skill):
    """Is paid for a pole that leans to the right."""

    def reward(self, step):
        return step.next_obs["pole"][:, 0]


def in_parts():
    env = replace(CARTPOLE, wrappers=[InParts])
    inner = inside(LeansLeft(), LeansRight(), env=env)
    return small(LeansRight(), inner, call_steps=7, env=env)


BUSY = {"call_steps": Lengths(1, ..., 8), "interrupt": True}
SHORT = {"skill_steps": 50, "selector_steps": 50, "together_steps": 150}
MODES = Automaton({"low": ["balance", "right"], "high": "right"}, {
    ("low", "high"): lambda step: step.next_obs[:, 2] > 0.02,
    ("high", "low"): lambda step: step.next_obs[:, 2] < 0,
})  # fmt: skip
KINDS = {
    "together": lambda: declare(learn="together", together=Together(task_weight=0.5)),
    "apart": lambda: declare(),
    "then": lambda: declare(learn="apart, then together"),
    "off-policy": lambda: declare(inside(algorithm=OFF, selector=OFF), learn="together"),
    "an off-policy selector above": lambda: declare(learn="together", selector=OFF),
    "memory": lambda: declare(inside(algorithm=MEMORY, selector=MEMORY), learn="together"),
    "interrupted": lambda: declare(inside(**BUSY), learn="together", **BUSY),
    "its own ends": lambda: declare(careful(), learn="together"),
    "its own ends apart": lambda: declare(careful(interrupt=True)),
    "a ready selector": lambda: declare(inside(selector=ready), learn="together"),
    "inside, then": lambda: declare(
        inside(learn="apart, then together", skill_steps=50, selector_steps=50)
    ),
    "inside, then, in some places": lambda: declare(
        inside(Balance(), learn="apart, then together", together_steps=200)
    ),
    "three": three,
    "observations in parts": in_parts,
    "guides": lambda: declare(
        inside(guide=MODES, guide_kl=0.05, reflexes=[Reflex(leans, 0)]),
        learn="together",
        guide=lambda obs: np.where(obs[:, 1] > 0, "left", "inner"),
        guide_restrict=False,
        guide_kl=0.1,
        reflexes=[Reflex(far, 1)],
    ),
    "guides, start calls": lambda: declare(
        inside(guide=MODES, start_calls=2), skill_steps=50, selector_steps=50
    ),
    "then, inside and outside": lambda: declare(
        inside(learn="apart, then together", **SHORT), learn="apart, then together", **SHORT
    ),
    "a ready selector above": lambda: declare(
        selector=lambda obs: np.where(obs[:, 1] > 0, "left", "inner"), learn="together"
    ),
}


def leans(obs):
    return obs[:, 2] > 0.05


def far(obs):
    return obs[:, 0] < -0.2


def ready(obs):
    """A selector that is not trained."""
    return np.where(np.abs(obs[:, 2]) < 0.05, 0, 1)


often = reports_every(75)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return Whole(KINDS, tmp_path_factory)


STOPS = dict.fromkeys(KINDS, (3, 4))
# After (3, 4) ticks these are at the start of a stage, where there is no checkpoint yet.
STOPS |= {"inside, then": (11, 4), "then, inside and outside": (11, 10)}
STOPS["a ready selector"] = (3, 9)  # after 4 its episodes are still the first ones
LATER = [("apart", (15, 11)), ("then", (32,)), ("inside, then", (7,)), ("three", (8,))]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "ticks"), [*STOPS.items(), *LATER])
def test_a_run_stopped_at_a_tick_ends_as_if_it_had_not_been(tmp_path, whole, kind, ticks):
    whole.assert_resumes(kind, ticks, tmp_path / "run")


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("kind", KINDS)
def test_what_a_run_learnt_is_loaded_and_written_to_one_file(tmp_path, whole, kind):
    whole.assert_loads(kind, tmp_path / "weights")
    run, _ = whole(kind)
    paths = list(roles_of(run.hierarchy).skills)
    assert list(run.evaluate(3).skills) == paths


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("kind", ["together", "then", "off-policy", "three"])
def test_all_learn_at_every_level_in_one_stream(whole, kind):
    _, path = whole(kind)
    entry = RunDirectory.open(path).manifest.stages[-1]
    assert entry.kind == "together"
    told = {name for line in lines(path) if line["stage"] == entry.name for name in line}
    deep = {k for k in entry.learns if "/" in k}
    assert {k.rpartition("/")[2] for k in deep} >= {"selector", "balance", "right"}
    for name in deep:
        assert any(k.startswith(f"{name}.") for k in told), f"{name} has learnt nothing"
    assert 450 <= entry.steps <= 450 + 32


def test_selectors_at_all_levels_stay_near_their_guides(whole):
    run, path = whole("guides")
    told = {name for line in lines(path) if line["stage"] == "together" for name in line}
    assert {"selector.reference_kl", "inner/selector.reference_kl"} <= told
    assert run.policy.guide is None
    assert run.policy.skills.policies[1].guide.restricts


def test_all_go_on_with_their_whole_states_by_path(tmp_path):
    """Stopped in the last stage, the states of all who learn there lie in the run."""
    run = stopped_run(KINDS["then, inside and outside"](), tmp_path / "run", 20)
    found = {f.name.removesuffix(".safetensors") for f in (run.path / "states").iterdir()}
    assert found == {"left", "selector", "inner.balance", "inner.right", "inner.selector"}
    entry = run.stage("inner/together")
    judged, entry.kept = entry.kept, Comparison("before")
    assert run.load_state("inner/right", SimpleNamespace()) is None, "it was not kept"
    entry.kept = judged
    KINDS["then, inside and outside"]().resume(run.path, quiet=True)
    assert not (run.path / "states").exists()


def test_a_run_is_described_and_evaluated_by_the_paths_of_its_skills(whole, capsys):
    run, path = whole("together")
    run.evaluate(3, save=True)
    assert main(["info", str(path)]) == 0
    told = capsys.readouterr().out
    for name in ("inner ", "inner/balance", "inner/right"):
        assert name in told
    assert run.evaluate(2, skill="inner/balance").mean > 0
    with pytest.raises(SkillweaveError, match="inner/balance"):
        run.evaluate(2, skill="inner/nobody")
    player = run.player(deterministic=False)
    acting = {run.policy.acts(player.memory) for _ in episode(CARTPOLE.make(), player)}
    assert acting & {"inner/right", "inner/balance"}, "captions of films"
    assert acting <= {"left", "inner/right", "inner/balance", "push"}


def test_calls_are_logged_by_the_paths_of_who_acts(whole):
    run, _ = whole("together")
    played = PlayedCalls(
        run.policy, (run.policy.observation_space, run.policy.action_space), own_rewards=True
    )
    score = evaluate(run.policy, CARTPOLE, episodes=4, watch=played.add)
    log = PlayedEpisodes(played, episode_seeds(0, 4))
    assert log.labels == ("left", "inner/balance", "inner/right", "push")
    for i, name in enumerate(log.labels):
        own = np.concatenate([e.calls[e.calls["skill"] == i] for e in log.episodes])
        told = score.skills[name]
        assert (len(own), own["steps"].sum()) == (told.calls, told.steps)
        ends = {name: int((own["end_reason"] == end).sum()) for end, name in ENDS.items()}
        assert ends == told.ended
        own_sum = own["own_return"].sum()
        assert own_sum == pytest.approx(told.return_sum, rel=1e-5, abs=1e-5)
    assert [len(e.rewards) for e in log.episodes] == list(score.lengths)
    for i, calls in enumerate(e.calls for e in log.episodes):
        ends = np.cumsum(calls["steps"])
        assert calls["age"].tolist() == [0, *ends[:-1]]
        assert ends[-1] == score.lengths[i]


def test_a_run_has_everyones_file_with_a_checksum(whole):
    _, path = whole("then")
    names = {name.removesuffix(".safetensors") for name in policies(path)}
    own = {"left", "selector", "inner.balance", "inner.right", "inner.selector"}
    assert names == own | {f"together.{name}" for name in own}
    stages = {s.name: s for s in RunDirectory.open(path).manifest.stages}
    assert set(stages) == {*(n.replace(".", "/") for n in own), "together"}
    assert all(s.sha256 or all(s.policies.values()) for s in stages.values())


class Task(Skill):
    """Has no code of its own."""


class Short(Skill):
    """Has no code of its own either."""

    max_steps = 4


def test_a_run_without_code_is_loaded_from_its_own_record(tmp_path, capsys):
    inner = inside(Short(), Task(), env="CartPole-v1", call_steps=2)
    found = small(Task(), inner, env="CartPole-v1", call_steps=3)
    run = found.train(tmp_path / "run", quiet=True)
    assert not run.info()["needs_recipe"]
    again = Hierarchy.from_manifest(run.info()).load(run.path)
    assert again.evaluate(3).returns == run.evaluate(3).returns
    assert list(roles_of(again.hierarchy).skills) == ["task", "inner", "inner/short", "inner/task"]
    assert main(["evaluate", str(run.path), "--episodes", "2"]) == 0
    assert "inner/short" in capsys.readouterr().out


def test_a_run_of_other_levels_or_with_a_policy_in_anothers_place_is_refused(tmp_path, whole):
    _, path = whole("apart")
    for other in (declare(inside(Right(), Balance())), declare(inside(name="other"))):
        with pytest.raises(SkillweaveError, match="inner/balance, inner/right"):
            other.load(path)
    with pytest.raises(SkillweaveError, match=r"inner has a trained selector, but .* a ready one"):
        declare(inside(selector=ready)).load(path)
    copy = RunDirectory.open(shutil.copytree(path, tmp_path / "run"))
    one, other = (copy.policy_path(f"inner/{k}") for k in ("balance", "right"))
    one.write_bytes(other.read_bytes())
    with pytest.raises(SkillweaveError, match="holds the policy of stage 'inner/right'"):
        declare().load(copy.path)


def test_another_guide_below_is_refused_by_its_path(tmp_path, whole):
    run, path = whole("guides, start calls")
    other = declare(inside(guide=lambda obs: 0, call_steps=Lengths(1, 2)))
    with (
        pytest.raises(SkillweaveError, match="guide of inner"),
        pytest.warns(match=r"call_steps of 'inner' is 3 .declared now: Lengths\(1, 2\)"),
    ):
        other.load(path)
    weights = run.save_weights(tmp_path / "weights")
    for load, source in ((declare().load, path), (declare().load_weights, weights)):
        with pytest.raises(SkillweaveError, match="inner: the selector has a guide"):
            load(source)


@pytest.mark.slow
def test_a_hierarchy_of_a_run_can_be_a_skill_beside_one_that_is_trained(tmp_path, whole):
    run, _ = whole("apart")
    found = small(run.as_skill("done"), inside(), call_steps=5)
    made = found.train(tmp_path / "run", quiet=True)
    assert {k.partition("/")[0] for k in made.evaluate(2).skills} == {"done", "inner"}
    assert found.load(tmp_path / "run").evaluate(2) == made.evaluate(2)


class Forever(Skill):
    """A skill whose policy is filled in later."""

    name = "loop"


def itself():
    skill = Forever()
    found = inside(Right(), skill)
    skill.policy = found
    return declare(found)


def gains_itself():
    found = declare()
    found.skills = (*found.skills, found.as_skill("again"))
    return found.train("never", quiet=True)


class Broken(Skill):
    def reward(self, step):
        return np.full(len(step.reward), np.nan)


def trained_twice():
    found = careful()
    found.algorithm = ON
    return found


WRONG = {
    "another environment": (
        lambda: declare(inside(env="Acrobot-v1")),
        "inner: .*Acrobot-v1.*CartPole-v1",
    ),
    "other settings of it": (
        lambda: declare(inside(env=EnvSpec("CartPole-v1", workers=1))),
        "inner: .*engine",
    ),
    "itself": (itself, "inner/loop is a hierarchy that contains itself"),
    "itself later": (gains_itself, "again is a hierarchy that contains itself"),
    "no end": (
        lambda: declare(call_steps=None),
        "skill 'inner' never ends|skill 'left'",
    ),
    "lengths of zero": (
        lambda: declare(inside().as_skill(call_steps=0)),
        "'inner'.*call_steps is 0",
    ),
    "an algorithm": (
        lambda: declare(trained_twice()),
        "skill 'careful' is a hierarchy, so it has no algorithm",
    ),
    "no such attribute": (lambda: inside().as_skill(cal_steps=3), "cal_steps"),
    "a reward that cannot be": (
        lambda: declare(inside(Broken()), learn="together").train("never", quiet=True),
        "'inner/broken'",
    ),
    "an algorithm that cannot": (
        lambda: declare(inside(algorithm=TD3(num_envs=4))).check_spaces(),
        "'inner/balance'",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_bad_declarations_are_told_by_path(case):
    make, told = WRONG[case]
    with pytest.raises(SkillweaveError, match=told):
        make()


def stage(name, kept):
    """An entry of ``run.json``: done and judged, done, or still waiting."""
    judged = kept in ("before", "greedy", "skills_sample")
    return stage_entry(
        name,
        "waiting" if kept == "waiting" else "done",
        compared=judged or kept == "unjudged",
        greedy_judged=kept != "alone",
        kept=Comparison(kept) if judged else None,
    )


@pytest.mark.parametrize(
    ("stages", "greedy"),
    [
        ({}, (True, True)),  # all apart
        ({"together": "greedy"}, (True, True)),
        ({"together": "skills_sample"}, (False, False)),
        ({"together": "waiting"}, (True, True)),
        ({"together": "unjudged"}, (True, True)),
        ({"inner/together": "skills_sample"}, (True, False)),
        ({"inner/together": "skills_sample", "together": "before"}, (True, False)),
        ({"inner/together": "skills_sample", "together": "greedy"}, (True, True)),
        ({"inner/together": "skills_sample", "together": "unjudged"}, (True, False)),
        ({"inner/together": "alone"}, (True, False)),  # it played no episodes: as it learnt
    ],
)
def test_whether_skills_are_greedy_is_what_the_latest_stage_says_that_counts(stages, greedy):
    run = SimpleNamespace(manifest=small_manifest(*(stage(*told) for told in stages.items())))
    found = resolve_greedy(roles_of(declare()), run).levels.values()
    assert tuple(level.selection.greedy_skills for level in found) == greedy
    declared = declare(inside(greedy_skills=False), greedy_skills=True)
    said = resolve_greedy(roles_of(declared), run).levels.values()
    assert [level.selection.greedy_skills for level in said] == [True, False]
