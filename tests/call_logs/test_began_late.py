"""Which calls count: those that began early enough to run their whole length, whatever came."""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from call_logs.logs import log_of

from skillweave import Hierarchy, Skill, evaluate
from skillweave.calls import CallLog, held, join
from skillweave.errors import RunError

A, B = 0, 1
LIMIT = 10
"""The time limit of the episodes here."""


def full(before: int, call: tuple[int, str, bool]) -> tuple[float, list]:
    """An episode: ``before`` steps of "a", then a call of "b" of so many steps, with its end."""
    steps, why, won = call
    first = [(A, [0] * before, True, "own")] if before else []
    return (0, [*first, (B, [1] * steps, won, why)])


RAN_OUT = full(4, (6, "cut", False))
"""An episode that shows the time limit: "b" is cut."""


def late_of(episodes: list, limits: tuple = (None, 4), **how: object) -> list[bool]:
    """Return of each call of "b" whether it began too late."""
    log = log_of(["a", "b"], episodes, limits=limits, **how)
    return log.began_late[log.skill == B].tolist()


def test_a_call_counts_if_its_limit_fits_before_the_time_limit_whatever_its_end():
    ends = [(1, "own", True), (1, "own", False), (1, "end", False), (1, "limit", True)]
    for age in range(1, LIMIT):
        cut = (LIMIT - age, "cut", True)
        found = late_of([RAN_OUT, *(full(age, end) for end in (*ends, cut))])
        assert found[1:] == [age + 4 > LIMIT] * 5
    # One that began with its episode is never too late.
    assert late_of([full(0, (10, "cut", True)), RAN_OUT], (None, 500)) == [False, True]


def test_without_a_limit_the_longest_call_that_came_to_its_own_end_counts():
    episodes = [full(2, (7, "own", True)), full(3, (1, "own", True)), full(4, (1, "own", True))]
    assert late_of([RAN_OUT, *episodes], (None, None)) == [True, False, False, True]
    # One that is stuck until the episode ends does not say how long a call takes.
    stuck = full(1, (9, "cut", False))
    assert late_of([stuck, *episodes], (None, None)) == [False, False, False, True]
    # Where none came to its end, the longest does.
    assert late_of([stuck, RAN_OUT], (None, None)) == [False, True]
    # Where none was cut, as it ends with the episode, say, each is known to its end.
    until_then = [full(0, (10, "end", True)), *episodes, full(9, (1, "own", True))]
    of_a = (0, [(A, [0] * 10, False, "cut")])
    assert late_of([of_a, *until_then], (None, None)) == [False] * 5


def test_the_length_that_was_drawn_is_a_limit():
    def of(length: int, age: int) -> tuple[float, list]:
        return (0, [(0, [0] * age, True, "own"), (2 + length, [1], True, "own")])

    episodes = [(0, [(0, [0] * 10, True, "cut")]), of(0, 8), of(0, 9), of(1, 4), of(1, 5)]
    log = log_of(["a", "b"], episodes, lengths=(2, 6), limits=(None, 5))
    assert log.whole_steps.tolist() == [2, 6, 2, 5]
    assert log.began_late[log.skill == B].tolist() == [False, True, False, False]


@pytest.mark.parametrize(
    "episodes",
    [
        [full(4, (6, "end", False)), full(9, (1, "own", True))],  # none was truncated
        [RAN_OUT, full(9, (2, "own", True))],  # one lasts longer than what was truncated
    ],
)
def test_without_a_time_limit_all_calls_count(episodes):
    assert not any(late_of(episodes))


def test_a_truncation_at_another_age_is_an_end_like_others():
    """Those who leave the track are truncated at once: that is no time limit."""
    off_track = [full(age, (2, "cut", False)) for age in (1, 2, 5)]
    log = log_of(["a", "b"], [RAN_OUT, *off_track, full(8, (2, "cut", True))], limits=(None, 4))
    assert log.began_late[log.skill == B].tolist() == [False] * 4 + [True]
    matrix = log.handover()
    assert (matrix.of("b", "a"), matrix.cut_else) == ((0.0, 4), 3)
    assert "In 3 calls the environment truncated the episode before step 10" in str(matrix)


def test_what_counts_does_not_depend_on_the_outcome():
    """Calls of 20 steps fall or not; whatever happens in late ones, the matrix is the same."""
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(200):
        calls, age = [], 0
        while age < LIMIT:
            skill = int(rng.integers(2))
            steps, won = int(rng.integers(1, 5)), bool(rng.integers(2))
            cut = age + steps >= LIMIT
            calls.append((skill, [0] * min(steps, LIMIT - age), won, "cut" if cut else "own"))
            age += steps
        episodes.append((0, calls))
    log = log_of(["a", "b"], episodes, limits=(4, 4))
    late, won = log.began_late, log.succeeded.copy()
    assert (late == (log.age > 6)).all()
    won[late] = ~won[late]
    other = replace(log, succeeded=won).handover()
    # A late call is the one before another only where that is late, too.
    assert (other.calls == log.handover().calls).all()
    assert (other.done == log.handover().done).all()


def test_parts_and_files_of_a_log_keep_its_time_limit(tmp_path):
    log = log_of(["a", "b"], [RAN_OUT, full(9, (1, "own", True))], limits=(None, 4))
    part = log.take(np.flatnonzero(log.episode == 1))
    assert part.began_late.tolist() == [False, True]
    assert join([part, part]).began_late.tolist() == [False, True] * 2
    longer = log_of(["a", "b"], [full(20, (1, "own", True))], limits=(None, 4))
    assert not join([log, longer]).began_late.any()
    with pytest.raises(RunError, match=r"the limits of calls .* differ between the logs"):
        join([log, replace(log, limits=(None, 5))])
    log = replace(log, seed=log.seed.astype(np.int64), order=log.order.astype(np.int64))
    log.save(tmp_path / "log.safetensors")
    assert CallLog.load(tmp_path / "log.safetensors").limits == (None, 4)


class Robot(gym.Env):
    """Upright; steps that the bad skill has acted. It falls in the 20th of these."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.bad, self.t = 0, 0
        return np.float32([1, 0]), {}

    def step(self, action):
        self.t += 1
        self.bad = self.bad + 1 if action[0] > 0 else 0
        fell = self.bad == 20
        return np.float32([not fell, self.bad]), 0.0, fell, self.t == 105, {}


class Stand(Skill):
    def policy(self, obs):
        return np.full((len(obs), 1), -1.0)

    def success(self, step):
        return step.next_obs[:, 0] == 1

    def termination(self, step):
        return step.next_obs[:, 0] == 0


class Fall(Stand):
    def policy(self, obs):
        return np.full((len(obs), 1), 1.0)


def robot(folder, call_steps, max_steps=None):
    skills = [Stand(), Fall()]
    skills[0].max_steps = max_steps
    hierarchy = Hierarchy(
        Robot, skills, call_steps=call_steps, selector=lambda obs: ["stand"] * len(obs)
    )
    return hierarchy.train(folder / "run", quiet=True)


@pytest.mark.parametrize("limits", [(100,), (30,), (None, 17)])
def test_a_skill_that_always_falls_is_not_done_because_the_time_is_over(tmp_path, limits):
    log = robot(tmp_path, *limits).log_calls(6_000, seed=0)
    matrix = log.handover()
    assert matrix.done[:, 1].sum() == 0
    assert matrix.calls[0, 1] > 20
    assert matrix.began_late[1, 1] > 0
    up = {name: held(lambda obs: obs[:, 0] == 1, 3) for name in ("stand", "fall")}
    assert (log.handover(up).calls == matrix.calls).all()
    assert "began too late" in str(matrix)
    assert "began too late" in matrix._repr_html_()
    fell = log.blame("fall", "start")
    assert (fell.rate, fell.calls) == (0.0, matrix.calls[0, 1])
    assert log.chain("stand", "fall").estimate == 0.0
    if limits == (100,):
        with pytest.raises(
            RunError, match=r"began too late .* 105 steps; that takes episodes of about"
        ):
            log.blame("fall", "stand")


def test_tables_of_skills_leave_them_out_too(tmp_path):
    score = evaluate(robot(tmp_path, 100).policy, Robot, episodes=5)
    stand = score.skills["stand"]
    # The second call of each episode has 5 steps of 100.
    assert (stand.calls, stand.began_late, stand.succeeded) == (10, 5, 10)
    assert (stand.counted, stand.success_rate) == (5, 1.0)
