"""A hierarchy that is a skill with goals: its selector sees the goal, and may pass it on."""

from __future__ import annotations

import numpy as np
import pytest
from small_runs import goes_on
from worlds import OFTEN, SELECTOR, SPACES, GoTo, Rest, aim_of, declared, go_to

import skillweave as sw
from skillweave.errors import RunError
from skillweave.experience.collector import Collector
from skillweave.experience.learners import Calling
from skillweave.skills.goal_spaces import with_goal


class Walk(GoTo):
    """A step towards the goal."""

    name = "walk"
    max_steps = 3

    def policy(self, obs, goal):
        return np.clip(5 * (aim_of(goal) - obs), -1, 1)


def outer_goals(obs):
    return np.full(len(obs), "far"), np.where(obs[:, :1] > 0, 0.7, 0.1) * np.ones((1, 2))


def far(inner, space: str = "box", **attributes) -> sw.Skill:
    """A hierarchy as a skill with goals."""
    methods = {"name": "far", "policy": inner, "goal_space": SPACES[space], "max_steps": 9}
    return type("Far", (GoTo,), methods | attributes)()


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(
    ("learn", "space"),
    [("together", "box"), ("apart", "number"), ("apart, then together", "dict"), ("apart", "box")],
)
def test_it_learns_and_goes_on_bit_for_bit(learn, space, tmp_path):
    def hierarchy():
        how = {"selector": SELECTOR, "learn": learn, "train_defaults": OFTEN, "call_steps": 3}
        inner = declared([go_to(), Rest()], name="inner", **how)
        outer = how | {"call_steps": 9, "steps": 1200}
        if space == "dict":  # by a rule
            outer["selector"] = lambda obs: (
                np.where(obs[:, 0] > 0, "rest", "far"),
                {"at": np.tanh(obs), "side": (obs[:, 1] > 0).astype(int)},
            )
        return declared([far(inner, space), Rest()], **outer)

    run = goes_on(hierarchy, tmp_path, 4)
    selector = run.policy.skills.policies[0].selector
    assert selector.observation_space == with_goal(run.policy.observation_space, SPACES[space])
    before = run.evaluate(3)
    assert {"far", "far/go_to"} <= set(before.skills)
    assert sw.load(run.path, hierarchy()).evaluate(3).returns == before.returns


def test_its_selector_learns_to_use_the_goal():
    """The inner selector alone can reach a goal; what it was never told, it could not."""

    rows = []
    original = Collector._views

    def views(self, trace, steps):
        found = original(self, trace, steps)
        if self.skill is not None and isinstance(self.who, Calling):
            batch = found[""]
            rows.append((batch["obs"], batch["next_obs"], batch["terminated"], batch.valid_rows))
        return found

    inner = declared([Walk(), Rest()], selector=SELECTOR, name="inner", call_steps=3, steps=400)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Collector, "_views", views)
        declared([far(inner), Rest()], selector=outer_goals, steps=None, call_steps=9).train(
            quiet=True
        )
    goals = set()
    for obs, after, terminated, mine in rows:
        assert (obs["goal"] == after["goal"])[mine].all()  # a call has one goal
        reached = np.abs(after["observation"] - after["goal"] % 2).max(-1) < 0.15
        assert (reached == terminated)[mine].all()  # judged by this goal
        goals |= {str(x) for x in obs["goal"][mine]}
    assert len(goals) > 5


def test_other_goals_are_refused():
    inner = declared([Walk(), Rest()], selector=SELECTOR, name="inner", call_steps=3, steps=200)

    def hierarchy(space):
        return declared([far(inner, space), Rest()], selector=outer_goals, call_steps=9)

    run = hierarchy("box").train(quiet=True)
    with pytest.raises(RunError, match=r"'far'.*was trained for goals of Box"):
        sw.load(run.path, hierarchy("unbounded"))
