"""Collectors tell in which rows a reflex acted instead of the learner."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from reference_calls import POSITION, Walk
from test_woven import Choices, Down, Learner, N, Stay, Up, Values, asked
from toy_acting import requests

from skillweave.collecting.calls import SkillSet
from skillweave.collecting.levels import UntrainedHierarchy
from skillweave.collecting.skill_rows import SkillCollector
from skillweave.collecting.woven import WovenCollector
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.hierarchy.schedule import stages_of
from skillweave.seeding import Seeds
from skillweave.skills import Reflex, Skill


def far(obs):
    return obs[:, POSITION] > 1


BACK = Reflex(far, 0)


class Inside(Skill):
    """A hierarchy."""


class Chooser(Learner):
    """A selector of two skills."""

    def __init__(self, num_envs):
        super().__init__(num_envs)
        self.actions = 2


class Begins(Down):
    """May start where the position is even."""

    def initiation(self, obs):
        return obs[:, POSITION] % 2 == 0


@pytest.mark.parametrize("skill", [None, Down(), Begins()])
def test_rows_of_a_skill_that_learns_by_itself(skill):
    engine = make_engine(EnvSpec(Walk, engine="sync"), N)
    collector = SkillCollector(engine, Choices(N, 3), skill, (BACK,))
    collector.start(Seeds(0))
    for request in itertools.islice(requests(30), 2):
        found = collector.collect(request).batches[""]
        moved = found["next_obs"][..., POSITION] - found["obs"][..., POSITION]
        np.testing.assert_array_equal(found["overridden"], found["obs"][..., POSITION] > 1)
        own = (
            ~found["overridden"]
            if found.get("valid") is None
            else found["valid"] & ~found["overridden"]
        )
        np.testing.assert_array_equal(moved[own], found["action"][own] - 1)
        assert found["overridden"].any()
    without = SkillCollector(make_engine(EnvSpec(Walk, engine="sync"), N), Choices(N, 3), skill)
    without.start(Seeds(0))
    assert without.collect(next(requests(5))).batches[""].get("overridden") is None


def test_rows_of_skills_that_learn_under_a_selector():
    skills = SkillSet((Up(), Down(), Stay()), (None, None, Stay.policy), (BACK,), 3)
    engine = make_engine(EnvSpec(Walk, engine="sync"), N)
    learners = {"up": Learner(N), "down": Learner(N), "skill_critic": Values(N)}
    collector = WovenCollector(engine, Choices(N, 3), skills, learners)
    collector.start(Seeds(7))
    seen = 0
    for request in itertools.islice(asked(40), 3):
        batches = collector.collect(request).batches
        own = batches["up"], batches["down"]
        assert "overridden" not in batches["skill_critic"]
        for rows in own:
            moved = rows["next_obs"][..., POSITION] - rows["obs"][..., POSITION]
            beyond = far(rows["obs"].reshape(-1, 4)).reshape(rows.lead)
            np.testing.assert_array_equal(rows["overridden"], beyond)
            mine = rows["valid"] & rows["overridden"]
            assert (moved[mine] == -1).all()
            clear = rows["valid"] & ~rows["overridden"]
            np.testing.assert_array_equal(moved[clear], rows["action"][clear] - 1)
            seen += mine.sum()
    assert seen > 4


def low(obs):
    return obs[:, POSITION] < 2


def test_reflexes_of_a_hierarchy_below_hold_where_it_acts_and_those_above_come_last():
    inner = SkillSet((Down(), Stay()), (None, Stay.policy), (Reflex(low, 2), Reflex(far, 2)), 2)
    skills = SkillSet(
        (Up(), Inside()), (None, UntrainedHierarchy(inner, None)), (BACK,), call_steps=3
    )
    engine = make_engine(EnvSpec(Walk, engine="sync"), N)
    learners = {"up": Learner(N), "inside/down": Learner(N), "inside/selector": Chooser(N)}
    collector = WovenCollector(engine, Choices(N, 2), skills, learners)
    collector.start(Seeds(7))
    seen = np.zeros(3, int)
    for request in itertools.islice(asked(40, learners), 4):
        batches = collector.collect(request).batches
        up, down = batches["up"], batches["inside/down"]
        position = up["obs"][..., POSITION]
        moved = up["next_obs"][..., POSITION] - position
        for rows, below in ((up, False), (down, True)):
            high, beneath = rows["valid"] & (position > 1), rows["valid"] & (position < 2)
            np.testing.assert_array_equal(
                rows["overridden"][rows["valid"]],
                ((position > 1) | (below & (position < 2)))[rows["valid"]],
            )
            assert (moved[high] == -1).all()
            assert not below or (moved[beneath] == 1).all()
            own = rows["valid"] & ~rows["overridden"]
            np.testing.assert_array_equal(moved[own], rows["action"][own] - 1)
            seen += (below * high.sum(), below * beneath.sum(), (not below) * beneath.sum())
    assert (seen > 2).all()


def test_reflexes_are_in_force_while_skills_learn():
    from test_together import declare

    hierarchy = declare(reflexes=[BACK])
    (stage,) = stages_of(hierarchy)
    skills = stage.scene(hierarchy.ready_policies()).skills
    assert skills.reflexes == (BACK,)
