"""Skills that learn under a ready selector, and selectors that learn with a guide."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from declaring import plainly
from ready_selectors import chain
from ready_selectors.chain import DOOR, KEY, PLACE, SPEC, Leave, Wait, got_key, has_key
from small_runs import OFF, ON, SMALL, Whole, lines, reports_every

from skillweave import (
    PPO,
    Apart,
    Automaton,
    Hierarchy,
    Lengths,
    Skill,
    SkillweaveError,
    Together,
    TrainDefaults,
    evaluate,
    tree,
)
from skillweave.errors import DeclarationError, RunError, SkillError
from skillweave.evolution import Evolution
from skillweave.runs.directory import RunDirectory


class GetKey(Skill):
    """Learns to get the key."""

    max_steps = 8

    def reward(self, step):
        return step.obs[:, PLACE] - step.next_obs[:, PLACE]

    def termination(self, step):
        return step.next_obs[:, KEY] == 1


class Open(Skill):
    """Learns to open the door; it may start with the key only."""

    max_steps = 8

    def initiation(self, obs):
        return obs[:, KEY] == 1

    def reward(self, step):
        return step.next_obs[:, PLACE] - step.obs[:, PLACE]

    def termination(self, step):
        return step.next_obs[:, DOOR] == 1

    def success(self, step):
        return step.next_obs[:, DOOR] == 1


AUTOMATON = Automaton(
    {"search": {"get_key", "wait"}, "unlock": ["open", "wait"], "free": "leave"},
    {("search", "unlock"): got_key, ("unlock", "free"): "success"},
)


def by_rule(obs):
    with_key = np.where(obs[:, DOOR] == 1, "leave", "open")
    return np.where(obs[:, KEY] == 1, with_key, "get_key")


TREE = tree.Sequence(tree.Fallback(has_key, "get_key"), "open", "leave")


def declare(*skills, **how):
    options: dict[str, Any] = {
        "env": SPEC,
        "skills": skills or [GetKey(), Open(), Leave(), Wait()],
        "call_steps": 4,
        "algorithm": ON,
        "selector": ON,
        "skill_steps": 150,
        "selector_steps": 200,
        "together_steps": 450,
        "checkpoint_every": 75,
        "greedy_skills": True,  # chance is another one with another number of environments
    }
    return Hierarchy(**plainly(options | how))


KINDS = {
    "automaton": lambda: declare(
        selector=AUTOMATON, learn="together", together=Together(task_weight=0.5)
    ),
    "function": lambda: declare(selector=by_rule, learn="together", algorithm=OFF),
    "tree, then": lambda: declare(selector=TREE, learn="apart, then together"),
    "restricted": lambda: declare(guide=AUTOMATON, learn="together"),
    "restricted, from replay": lambda: declare(guide=AUTOMATON, selector=OFF, selector_steps=450),
    "near a tree": lambda: declare(guide=TREE, guide_restrict=False, guide_kl=0.05),
    "near and restricted, then": lambda: declare(
        guide=AUTOMATON, guide_kl=0.1, learn="apart, then together", call_steps=Lengths(1, 4)
    ),
    "lengths by a rule": lambda: declare(guide=by_rule, call_steps=Lengths(1, 2, 4)),
}


often = reports_every(75)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return Whole(KINDS, tmp_path_factory)


STOPS = dict.fromkeys(KINDS, (3, 4))
# The last one is in the selector's stage.
STOPS |= dict.fromkeys(("restricted, from replay", "near a tree", "lengths by a rule"), (3, 2, 12))
STOPS |= dict.fromkeys(("tree, then", "near and restricted, then"), (3, 4, 19))
# After (3, 4) their episodes, of 40 steps, are still the first ones.
STOPS |= dict.fromkeys(("automaton", "restricted"), (3, 9))


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(("kind", "ticks"), STOPS.items())
def test_a_run_stopped_at_a_tick_ends_as_if_it_had_not_been(tmp_path, whole, kind, ticks):
    whole.assert_resumes(kind, ticks, tmp_path / "run")


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("kind", KINDS)
def test_what_a_run_learnt_is_loaded_and_written_to_one_file(tmp_path, whole, kind):
    whole.assert_loads(kind, tmp_path / "weights")
    run, _ = whole(kind)
    assert evaluate(run.policy, SPEC, episodes=6, num_envs=1) == run.evaluate(6)


def test_skills_learn_where_a_ready_selector_calls_them(whole):
    _, path = whole("automaton")
    (entry,) = RunDirectory.open(path).manifest.stages
    assert entry.learns == ["get_key", "open", "skill_critic"]
    told = [name for line in lines(path) for name in line]
    assert "get_key.samples" in told
    assert not any(name.startswith("selector.") for name in told)


@pytest.mark.slow
def test_skills_that_learn_under_a_ready_selector_solve_the_corridor(tmp_path):
    # To stay is nearly as good as to go, as there is time. After 12,000 steps greedy skills stay at
    # the door with a third of the seeds; after 24,000 with none of 0 to 11.
    skilled = declare(
        selector=AUTOMATON, learn="together", together_steps=24_000,
        algorithm=PPO(
            num_envs=8, n_steps=32, batch_size=64, update_epochs=10, network=SMALL,
            learning_rate=3e-3,
        ),
    )  # fmt: skip
    assert skilled.train(tmp_path / "run", seed=0, quiet=True).evaluate(30).mean > 0.9


def calls_of(policy, guide, seeds=6):
    """(state of the automaton at each decision, the skill that was called)."""
    return [
        (guide.state_names[int(before["guide.state"][0])], policy.labels[int(after["skill"][0])])
        for seed in range(seeds)
        for before, after in chain.played(policy, seed, deterministic=False)
        if before["end"][0] != 0
    ]


CHAIN = Automaton(
    {"search": {"get_key", "wait"}, "unlock": ["open_door", "wait"], "free": "leave"},
    {("search", "unlock"): got_key, ("unlock", "free"): "success"},
)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("selector", [ON, OFF])
@pytest.mark.parametrize("learn", ["apart", "together"])
def test_a_restricted_selector_calls_nothing_else_also_when_it_is_trained(
    selector, learn, tmp_path
):
    skills = [chain.GetKey(), chain.OpenDoor(), chain.Leave(), chain.Wait()]
    run = declare(*skills, guide=CHAIN, selector=selector, learn=learn).train(
        tmp_path / "run", quiet=True
    )
    calls = calls_of(run.policy, CHAIN)
    for state, skill in calls:
        assert skill in CHAIN.states[state]
    if selector is ON:  # a DQN that waits once waits for ever
        assert {state for state, _ in calls} == {"search", "unlock", "free"}
        assert run.evaluate(40, deterministic=False).mean > 0.5


@pytest.mark.slow
def test_a_selector_near_its_guide_does_what_the_guide_does(tmp_path):
    def shares(**how):
        # What the task pays says nothing here: no call is worth more than another.
        skills = [Wait(), type("Other", (Wait,), {"name": "other"})()]
        hierarchy = Hierarchy(
            SPEC,
            skills,
            selector=PPO(num_envs=4, n_steps=32, network=SMALL, learning_rate=1e-2),
            call_steps=2,
            apart=Apart(selector_steps=6_000),
            train_defaults=TrainDefaults(checkpoint_every=100_000),
            **plainly(how),
        )
        run = hierarchy.train(tmp_path / str(len(how)), seed=1, quiet=True)
        told = [line for line in lines(run.path) if "reference_kl" in line]
        found = run.evaluate(20, deterministic=False).skill_steps
        return found["other"] / sum(found.values()), told

    free, told = shares()
    assert not told
    near, told = shares(guide=lambda obs: ["other"] * len(obs), guide_restrict=False,
                        guide_kl=0.02)  # fmt: skip
    assert near > 0.8 > free
    assert told[-1]["reference_kl"] < 0.2 * told[0]["reference_kl"]


@pytest.mark.slow
def test_a_population_of_restricted_selectors_evolves(tmp_path):
    skills = [
        Leave(),
        Wait(),
        type("Back", (Wait,), {"policy": chain.always(0)})(),
    ]
    for skill in skills:
        skill.max_steps = 2
    guide = Automaton({"a": {"back"}, "b": {"leave", "wait"}}, {("a", "b"): got_key})
    hierarchy = declare(*skills, guide=guide, selector_steps=400)
    evolve = {"selector": Evolution(population=2, generations=2, episodes=2)}
    run = hierarchy.train(tmp_path / "run", quiet=True, evolve=evolve)
    for state, skill in calls_of(run.policy, guide):
        assert skill in guide.states[state]
    near = declare(*skills, guide=guide, guide_kl=0.1)
    with pytest.raises(SkillweaveError, match="not kept near a guide"):
        near.train(tmp_path / "near", quiet=True, evolve=evolve)


WRONG: dict[str, dict[str, Any]] = {
    "the guide has no effect": {"guide": AUTOMATON, "guide_restrict": False},
    "only PPO can be kept near": {"guide": AUTOMATON, "guide_kl": 0.1, "selector": OFF},
    "has nothing to choose": {"guide": by_rule},
    "returns only at decisions": {
        "guide": by_rule, "call_steps": Lengths(1, 2), "selector": OFF
    },
    "the guide restricts which skill": {"guide": AUTOMATON, "interrupt": True},
    "a guide is given, but the selector is ready": {"guide": TREE, "selector": by_rule},
    "names 'fly', which is no skill": {"guide": Automaton({"a": "fly"}, {})},
}  # fmt: skip


@pytest.mark.parametrize("says", WRONG)
def test_a_wrong_declaration_is_told(says):
    with pytest.raises(DeclarationError, match=says):
        declare(**WRONG[says])


def test_a_guide_that_fails_is_told_and_before_anything_is_trained_if_it_always_does(tmp_path):
    def wrong(obs):
        return np.full(len(obs), 9)

    hierarchy = declare(guide=wrong, guide_restrict=False, guide_kl=0.1)
    with pytest.raises(SkillError, match=r"guide: function wrong\(\) returned 9"):
        hierarchy.train(tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()
    stuck = Automaton({"search": "open", "x": "wait"}, {})
    with pytest.raises(SkillError, match=r"'search' none of its skills \(open\) may start"):
        declare(guide=stuck, learn="together").train(tmp_path / "run", quiet=True)


def test_a_run_with_another_guide_is_refused(whole, tmp_path):
    run, path = whole("restricted")
    weights = run.save_weights(tmp_path / "weights")
    other = Automaton({"a": "wait"}, {})
    for declared, message in (
        (declare(learn="together"), "has a guide, but the selector of this hierarchy has no guide"),
        (declare(learn="together", guide=other), "another checksum"),
    ):
        with pytest.raises(RunError, match=message):
            declared.load(path)
        with pytest.raises(RunError, match=message):
            declared.load_weights(weights)
    plain = declare().train(tmp_path / "plain", quiet=True)
    with pytest.raises(RunError, match="has no guide, but the selector of this hierarchy has a"):
        declare(guide=AUTOMATON).load(plain.path)
