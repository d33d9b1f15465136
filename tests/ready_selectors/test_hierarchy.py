"""Hierarchies with ready selectors: declared, trained, saved, loaded, woven into others."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from declaring import plainly
from ready_selectors.chain import (
    KEY,
    PLACE,
    SPEC,
    GetKey,
    Leave,
    OpenDoor,
    Wait,
    got_key,
    has_key,
)

from skillweave import PPO, Automaton, Hierarchy, SkillweaveError, tree
from skillweave.cli import main
from skillweave.cli.overrides import apply_overrides, list_settings
from skillweave.hierarchy.roles import roles_of
from skillweave.runs.directory import RunDirectory
from skillweave.skills import Skill
from skillweave.types import LastCall

SMALL = PPO(num_envs=2, n_steps=8, batch_size=16)


def by_rule(obs: Any) -> Any:
    return np.where(obs[:, KEY] == 1, np.where(obs[:, PLACE] == 6, "leave", "open_door"), "get_key")


def by_last(obs: Any, last: LastCall) -> Any:
    """One skill after another, each until it succeeds; leaving is tried for ever."""
    begun = np.maximum(last.skill, 0)
    return np.minimum(begun + last.succeeded, 2)


SELECTORS = {
    "function": by_rule,
    "function of the last call": by_last,
    "automaton": Automaton(
        {"search": {"get_key"}, "unlock": "open_door", "free": ["leave", "wait"]},
        {("search", "unlock"): got_key, ("unlock", "free"): "success"},
    ),
    "tree": tree.Sequence(tree.Fallback(has_key, "get_key"), "open_door", "leave"),
}


def declare(selector: Any, *more: Skill, **settings: Any) -> Hierarchy:
    skills = [GetKey(), OpenDoor(), Leave(), Wait(), *more]
    settings = {"call_steps": 3, "algorithm": SMALL, "skill_steps": 64} | settings
    return Hierarchy(SPEC, skills, selector=selector, **plainly(settings))


@pytest.mark.parametrize("kind", SELECTORS)
def test_it_solves_the_corridor_without_training(kind, tmp_path):
    run = declare(SELECTORS[kind]).train(tmp_path / "run", quiet=True)
    score = run.evaluate(20)
    assert score.returns == (1.0,) * 20
    # From place p: p steps to the key, 6 to the door, 1 beyond.
    assert set(score.lengths) == {p + 7 for p in range(1, 6)}
    assert run.info()["stages"] == []
    assert RunDirectory.open(run.path).finished


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("kind", ["tree", "automaton"])
def test_as_a_skill_under_a_selector_that_is_trained(kind, tmp_path):
    inner = declare(SELECTORS[kind]).train(tmp_path / "run", quiet=True).as_skill("inner")

    def outer() -> Hierarchy:
        steps = {"call_steps": 4, "selector_steps": 128, "checkpoint_every": 32}
        return Hierarchy(SPEC, [inner, Wait()], selector=SMALL, **plainly(steps))

    run = outer().train(tmp_path / "outer", quiet=True)
    assert outer().load(run.path).evaluate(8) == run.evaluate(8)
    assert run.evaluate(8, skill="inner").returns == (1.0,) * 8


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run with a skill that learns, under an automaton."""
    return declare(SELECTORS["automaton"], Learnt()).train(
        tmp_path_factory.mktemp("ready") / "run", seed=1, quiet=True
    )


class Learnt(Skill):
    """A skill that is trained."""

    max_steps = 4


def test_skills_are_trained_apart_and_the_selector_is_not(trained, capsys):
    manifest = json.loads((trained.path / "run.json").read_text())
    assert [s["name"] for s in manifest["stages"]] == ["learnt"]
    assert [s["status"] for s in manifest["stages"]] == ["done"]
    assert manifest["hierarchy"]["selector"]["kind"] == "automaton"
    assert len(manifest["hierarchy"]["selector"]["sha256"]) == 64
    assert manifest["needs_recipe"]
    assert manifest["resume_needs_recipe"]
    assert {p.name for p in (trained.path / "policies").iterdir()} == {"learnt.safetensors"}
    assert main(["info", str(trained.path)]) == 0
    assert "call_steps 3, ready selector: automaton\n" in capsys.readouterr().out


def test_trained_loaded_and_exported_act_the_same(trained, tmp_path):
    again = declare(SELECTORS["automaton"], Learnt())
    assert again.load(trained.path).evaluate(10) == trained.evaluate(10)
    file = trained.save_weights(tmp_path / "weights.safetensors")
    assert again.load_weights(file).evaluate(10) == trained.evaluate(10)
    assert again.resume(trained.path, quiet=True).evaluate(10) == trained.evaluate(10)
    assert trained.evaluate(10).returns == (1.0,) * 10


OTHERS = {
    "another automaton": (Automaton({"x": "wait"}, {}), "automaton.*another checksum"),
    "a tree": (SELECTORS["tree"], "kind automaton.*now it is tree"),
    "a trained selector": (SMALL, "a ready one.*but this hierarchy has a trained selector"),
}


@pytest.mark.parametrize("case", OTHERS)
def test_a_run_of_another_selector_is_refused(case, trained, tmp_path):
    selector, message = OTHERS[case]
    other = declare(selector, Learnt())
    with pytest.raises(SkillweaveError, match=message):
        other.load(trained.path)
    with pytest.raises(SkillweaveError, match=message):
        other.load_weights(trained.save_weights(tmp_path / "weights.safetensors"))


def test_a_run_of_a_trained_selector_is_refused_where_it_is_ready(tmp_path):
    trained = declare(SMALL, selector_steps=32).train(tmp_path / "run", quiet=True)
    weights = trained.save_weights(tmp_path / "weights.safetensors")
    ready = declare(by_rule)
    for load in (lambda: ready.load(trained.path), lambda: ready.load_weights(weights)):
        with pytest.raises(SkillweaveError, match=r"trained selector, but this .* a ready one"):
            load()


def test_a_ready_selector_takes_no_steps():
    ready = declare(by_rule, Learnt(), selector_steps=1000)
    assert ready.total_steps == 64
    assert ready.plain_agent().steps == 64
    assert declare(SMALL, Learnt(), selector_steps=1000).total_steps == 1064
    assert not roles_of(ready).is_data
    assert declare(by_rule, steps=50).plain_agent().steps == 50


def test_its_source_as_a_skill_of_another_run_is_that_of_all_below_it(tmp_path):
    first = declare(SELECTORS["automaton"]).train(tmp_path / "a", quiet=True).policy.source()
    same = declare(SELECTORS["automaton"]).train(tmp_path / "b", quiet=True).policy.source()
    other = declare(SELECTORS["tree"]).train(tmp_path / "c", quiet=True).policy.source()
    assert first == same
    assert first != other


def test_settings_of_the_selector_on_the_command_line():
    declaration = declare(by_rule)
    assert not any(name.startswith("selector.") for name in list_settings(declaration))
    apply_overrides(declaration, ["selector=PPO", "selector.gamma=0.5"])
    assert declaration.selector.gamma == 0.5
