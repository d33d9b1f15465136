"""Collectors tell in which rows a reflex acted instead of the learner."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from joint_learners import Down, Learner, N, Stay, Up, Values, asked
from reference_calls import POSITION, Walk
from toy_acting import Choices, requests
from toys import alone_in, calling_in

from skillweave._internal.seeding import Seeds
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.hierarchy.fitting import ready_policies
from skillweave.hierarchy.roles import roles_of
from skillweave.skills import Reflex
from skillweave.skills.skill_set import SkillSet


def far(obs):
    return obs[:, POSITION] > 1


BACK = Reflex(far, 0)


class Begins(Down):
    """May start where the position is even."""

    def initiation(self, obs):
        return obs[:, POSITION] % 2 == 0


@pytest.mark.parametrize("skill", [None, Down(), Begins()])
def test_rows_of_a_skill_that_learns_by_itself(skill):
    engine = make_engine(EnvSpec(Walk, engine="sync"), N)
    collector = alone_in(engine, Choices(N, 3), skill, (BACK,))
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
    without = alone_in(make_engine(EnvSpec(Walk, engine="sync"), N), Choices(N, 3), skill)
    without.start(Seeds(0))
    assert without.collect(next(requests(5))).batches[""].get("overridden") is None


def test_rows_of_skills_that_learn_under_a_selector():
    skills = SkillSet((Up(), Down(), Stay()), (None, None, Stay.policy), (BACK,), 3)
    engine = make_engine(EnvSpec(Walk, engine="sync"), N)
    learners = {"up": Learner(N), "down": Learner(N), "skill_critic": Values(N)}
    collector = calling_in(engine, Choices(N, 3), skills, learners=learners)
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


def test_reflexes_are_in_force_while_skills_learn():
    from declaring import declare

    hierarchy = declare(reflexes=[BACK])
    (stage,) = hierarchy.stages()
    skills = stage.learning_task(ready_policies(roles_of(hierarchy))).who.skills
    assert skills.reflexes == (BACK,)
