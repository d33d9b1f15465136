"""Steps of a request are judged by one call of a skill, and as if each had been judged alone."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from reference_calls import POSITION, Walk, scripted
from toy_acting import Choices, requests
from toys import alone_in, calling_in

from skillweave._internal.seeding import Seeds
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import EnvError, SkillError
from skillweave.experience.collector import Collector
from skillweave.skills import Skill
from skillweave.skills.skill_set import SkillSet

N, ROWS = 3, 12


class Tells(Walk):
    """Its info has values of all kinds, some in some steps only; one object changes in place."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[float] = []

    def step(self, action: int) -> Any:
        obs, reward, terminated, truncated, info = super().step(action)
        at = float(obs[POSITION])
        self.seen.append(at)
        info |= {"number": at, "deep": {"number": 2 * at, "word": str(at)}, "list": self.seen}
        info["kind"] = at if self.t % 3 else None
        if self.t % 2:
            info["sometimes"] = at
        if terminated or truncated:
            info["episode"] = {"r": at}
        return obs, reward, terminated, truncated, info


def numbers(step: Any) -> Any:
    return step.info["number"]


def deep(step: Any) -> Any:
    words = np.array([float(word) for word in step.info["deep"]["word"]])
    return step.info["deep"]["number"] + words


def changing(step: Any) -> Any:
    return np.array([sum(values) for values in step.info["list"]])


def of_any_kind(step: Any) -> Any:
    return np.array([-1.0 if value is None else value for value in step.info["kind"]])


def sometimes(step: Any) -> Any:
    return step.info.get("sometimes", np.full(len(step.reward), 7.0))


def asks(step: Any) -> Any:
    return np.full(len(step.reward), 3.0 if "sometimes" in step.info else 4.0)


def at_ends(step: Any) -> Any:
    return np.asarray(step.info["episode"]["r"] if "episode" in step.info else step.reward)


def all_keys(step: Any) -> Any:
    return np.full(len(step.reward), float(len(step.info)))


READERS = (numbers, deep, changing, of_any_kind, sometimes, asks, at_ends, all_keys)


def skill_of(pays: Any, **more: Any) -> Any:
    return type("Reads", (Skill,), {"max_steps": 4, "reward": lambda _, step: pays(step)} | more)()


def alone(skill: Any, env: Any = Tells) -> Collector:
    engine = make_engine(EnvSpec(env, engine="sync"), N)
    collector = alone_in(engine, Choices(N, 3), skill)  # type: ignore[arg-type]
    collector.start(Seeds(3))
    return collector


def below(skill: Any) -> Collector:
    class Rest(Skill):
        policy = scripted(1)

    engine = make_engine(EnvSpec(Tells, engine="sync"), N)
    acting: Any = Choices(N, 2)
    acting.stacks = ((engine, 1),)  # it has the action space
    learner: Any = Choices(N, 3)
    learner.stacks = acting.stacks
    skills = SkillSet((skill, Rest()), (None, Rest.policy), call_steps=3)  # type: ignore[arg-type]
    collector = calling_in(engine, acting, skills, learners={"reads": learner})
    collector.start(Seeds(3))
    return collector


def rewards(collector: Any, rows: int, path: str) -> Any:
    """Rewards of 24 rows, in requests of as many."""
    found = []
    for request in itertools.islice(requests(rows), 24 // rows):
        batches = collector.collect(replace(request, below={"reads": request})).batches
        found.append(np.where(batches[path].valid_rows, batches[path]["reward"], 0.0))
    return np.concatenate(found)


@pytest.mark.usefixtures("unprobed")
@pytest.mark.parametrize("pays", READERS)
@pytest.mark.parametrize(("make", "path"), [(alone, ""), (below, "reads")])
def test_each_row_sees_what_its_environment_gave(make: Any, path: str, pays: Any) -> None:
    once = rewards(make(skill_of(pays)), ROWS, path)
    np.testing.assert_array_equal(once, rewards(make(skill_of(pays)), 1, path))
    assert len(np.unique(once)) > 1 or pays is asks


@pytest.mark.usefixtures("unprobed")
@pytest.mark.parametrize(("make", "path"), [(alone, ""), (below, "reads")])
def test_a_reward_is_called_once_in_a_request(make: Any, path: str) -> None:
    sizes: list[int] = []

    def pays(step: Any) -> Any:
        sizes.append(len(step.reward))
        return numbers(step)

    collector = make(skill_of(pays))
    for request in itertools.islice(requests(ROWS), 2):
        sizes.clear()  # its first call is compared with others
        rows = collector.collect(replace(request, below={"reads": request})).batches[path]
    assert sizes == [int(rows.valid_rows.sum())]


@pytest.mark.usefixtures("unprobed")
@pytest.mark.parametrize("pays", [numbers, sometimes])
def test_large_observations_are_judged_in_parts(pays: Any, monkeypatch: Any) -> None:
    whole = rewards(alone(skill_of(pays)), ROWS, "")
    monkeypatch.setattr("skillweave.experience.views.AT_ONCE", 5 * alone(None).obs.nbytes)
    sizes: list[int] = []

    def counted(step: Any) -> Any:
        sizes.append(len(step.reward))
        return pays(step)

    np.testing.assert_array_equal(rewards(alone(skill_of(counted)), ROWS, ""), whole)
    assert max(sizes) == 5 * N


@pytest.mark.usefixtures("unprobed")
@pytest.mark.parametrize(("make", "path"), [(alone, ""), (below, "reads")])
def test_a_reward_that_changes_gets_each_step_once_and_in_order(make: Any, path: str) -> None:
    found = []
    for rows in (ROWS, 1):
        given: list[list[float]] = []

        def pays(step: Any, given: Any = given) -> Any:
            given.append(step.next_obs.tolist())
            return np.full(len(step.reward), float(len(given)))

        skill = skill_of(pays, reward_changes=True)
        found.append((rewards(make(skill), rows, path).tolist(), given))
    assert found[0] == found[1]
    assert len(found[0][1]) == 24 or path


@pytest.mark.parametrize(("make", "path"), [(alone, ""), (below, "reads")])
@pytest.mark.parametrize(
    "wrong",
    [
        lambda step: np.where(step.info["number"] >= 1, np.nan, 0.0),
        lambda step: 1 / 0 if (step.info["number"] >= 1).any() else step.reward,
        lambda step: step.reward[:-1] if (step.info["number"] >= 1).any() else step.reward,
    ],
)
def test_a_wrong_reward_has_the_message_of_the_step_in_which_it_is_wrong(
    make: Any, path: str, wrong: Any
) -> None:
    messages = []
    for rows in (ROWS, 1):
        with pytest.raises(SkillError) as error:
            rewards(make(skill_of(wrong)), rows, path)
        messages.append(str(error.value))
    assert messages[0] == messages[1]
    assert " at step " in messages[0]


class Handle:
    """Cannot be copied."""

    def __deepcopy__(self, memo: Any) -> Any:
        raise TypeError("a handle")

    value = 1.0


class Holds(Walk):
    """Its info holds a handle."""

    def step(self, action: int) -> Any:
        *found, info = super().step(action)
        return *found, info | {"handle": Handle()}


def test_an_object_that_cannot_be_copied_is_refused_where_it_is_read() -> None:
    rewards(alone(skill_of(lambda step: step.reward), Holds), ROWS, "")
    reads = skill_of(lambda step: np.array([x.value for x in step.info["handle"]]))
    with pytest.raises(EnvError, match=r"info\['handle'\] holds an object that cannot be copied"):
        rewards(alone(reads, Holds), ROWS, "")
