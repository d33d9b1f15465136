"""Goals for which a call would end at once: they are chosen again."""

import numpy as np
from goals.worlds import ON, GoTo, Point, declared, go_to

from skillweave.policies.hierarchy import TRIES
from skillweave.skills.goals import Goals


class Grid(GoTo):
    """Draws one of the places −0.8, −0.7, … 0.8, and counts how often."""

    asked = 0

    def goals(self, obs, rng):
        self.asked += 1
        return np.repeat(rng.integers(-8, 9, (len(obs), 1)) / 10, 2, 1).astype(np.float32)


class ReadsInfo(Grid):
    def termination(self, step):
        return step.info["near"]


class Always(Grid):
    def termination(self, step):
        return np.ones(len(step.reward), bool)


def test_goals_that_hold_are_drawn_again_in_practice():
    obs, rng = np.full((300, 2), 0.4, np.float32), np.random.default_rng
    drawn = Goals(Grid()).draw(obs, rng(0))
    assert np.abs(drawn - 0.4).max(1).min() > 0.15
    assert len(np.unique(drawn)) == 17 - 3
    for skill, times in ((ReadsInfo(), 1), (Always(), TRIES)):
        drawn = Goals(skill).draw(obs, rng(0))
        assert skill.asked == times
        assert len(np.unique(drawn)) == 17


class Middle(Point):
    """Starts at 0."""

    def reset(self, **how):
        super().reset(**how)
        self.place = np.zeros(2, np.float32)
        return self._obs(), {}


def test_a_goal_that_holds_is_no_decision_of_a_selector_that_learns():
    stays = go_to("number", policy=lambda obs, goal: 0 * obs, max_steps=2)
    hierarchy = declared([stays], env=Middle, selector=ON, steps=128)
    run = hierarchy.train(log_calls=100, quiet=True)
    assert (run.calls.goals["go_to"] == 3).all()
    assert (run.calls.tau == 2).all()
