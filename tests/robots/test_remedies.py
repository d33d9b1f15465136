"""Remedies: chosen on some robots and reported on others, each beside the pair without it."""

from __future__ import annotations

import os
import signal
from typing import Any

import numpy as np
import pytest
from robots.owner import DRIVE, SPEEDS, driving, policies, up, waving
from robots.test_handovers import VARY, Line, moving

import skillweave as sw
from skillweave.errors import DeclarationError
from skillweave.robots.measuring import MeasuredHandovers
from skillweave.robots.remedies import APART, Effect, Remedies, Tried, _entries
from skillweave.toys.balancer import Balancer


def measured(*names: str, **more: Any) -> MeasuredHandovers:
    skills = {name: policy for name, policy in policies().items() if name in names}
    return sw.handovers(
        Balancer, skills, steps=100, stays=up, calls=1, vary=VARY, quiet=True, **more
    )


def test_one_is_chosen_and_reported_on_other_robots() -> None:
    found = measured("fast", "stand", "wave").remedies("fast", "wave", robots=8, quiet=True)
    assert (found.robots, found.without) == (8, 0)
    best = found.best
    assert best is not None
    assert best.name == "stand in between"
    assert (best.done, best.won, best.lost) == (16, 16, 0)  # with as many robots again
    assert (found.again, found.without_again) == (16, 0)
    assert found.finals[0] == best
    assert (found.tried[0].done, found.tried[0].won) == (8, 8)
    assert found.effect == Effect("fast", 8, 0, 8, 8, 0)
    assert found.effect.chance == 2 / 2**8
    assert "Chosen: stand in between. On other robots: after fast: 0 of 8 without" in str(found)
    names = [one.name for one in found.tried]
    assert set(names) == {
        "stand in between", "cross-fade over 12 steps", "cross-fade over 25 steps",
        "ramp over 12 steps", "ramp over 25 steps", "fast cut 12 steps later",
        "fast cut 25 steps later",
    }  # fmt: skip


def test_none_helps_is_an_answer() -> None:
    found = measured("fast", "wave").remedies("fast", "wave", robots=5, quiet=True)
    assert found.best is None
    assert found.effect is None
    assert "None helps" in str(found)
    assert found.to_json()["best"] is None


def test_another_policy_in_its_place_may_be_one() -> None:
    def steady(x: Any) -> Any:
        return np.stack([x @ DRIVE[:3], np.full(len(x), 0.1)], axis=1)

    hidden = sw.from_function(steady, sees=("tilt", "gyro", "speed"))
    drive = sw.from_function(driving, sees=("tilt", "gyro", "speed", sw.Goal()))
    skills = {name: policies()[name] for name in ("fast", "wave")}
    skills["faster"] = drive.with_goal((1.6,))
    made = sw.handovers(Balancer, skills, steps=100, stays=up, calls=1, vary=VARY, quiet=True)
    found = made.remedies("fast", "wave", robots=6, instead={"gentle": hidden}, quiet=True)
    assert found.tried[0].name == "gentle"
    assert found.best is not None
    assert [(e.after, e.robots, e.lost) for e in found.elsewhere] == [("faster", 6, 0)]


def mixing(seed: int, settings: dict[str, Any], cut: int, way: str, steps: int) -> bool:
    """Whether the wave after a slow drive stays up, in a plain loop."""
    env = Balancer(**settings)
    obs, _ = env.reset(seed=seed)
    last = np.zeros(2)
    for t in range(cut + 100):
        x = np.array([[obs[k][0] for k in ("tilt", "gyro", "speed")]], np.float32)
        drive = driving(np.concatenate([x, [[SPEEDS["slow"]]]], axis=1)).clip(-1, 1)
        wave = waving(x).clip(-1, 1)
        share = np.float64(min(1.0, (t - cut + 1) / steps))
        base = drive[0] if way == "fade" else last
        if t == cut:
            origin = last
        if way == "ramp" and t >= cut:
            base = origin
        action = drive[0] if t < cut else share * np.float32(wave[0]) + (1 - share) * base
        action = action.astype(np.float32)
        obs, _, fell, _, _ = env.step(action)
        last = action
        if fell or not up({"tilt": obs["tilt"][None]})[0]:
            assert t >= cut
            return False
    return True


def test_ramps_and_cross_fades_are_what_a_plain_loop_does() -> None:
    vary = {"latency": (0, 3), "grip": (0.8, 1.0)}
    skills = {name: policy for name, policy in policies().items() if name in ("slow", "wave")}
    found = sw.handovers(Balancer, skills, steps=100, stays=up, calls=1, vary=vary, quiet=True)
    remedies = found.remedies("slow", "wave", robots=20, quiet=True)
    done = {one.name: one.done for one in remedies.tried}
    for way, name in (("fade", "cross-fade over 25 steps"), ("ramp", "ramp over 25 steps")):
        wanted = 0
        robots = found.trial.robots(APART)
        for _ in range(20):
            robot = next(robots)
            cut = found.trial.cut(robot, 0)
            wanted += mixing(robot.seed, robot.settings, cut, way, 25)
        assert done[name] == wanted
        assert 3 < wanted <= 20


def test_it_says_which_other_pairs_a_remedy_makes_worse() -> None:
    tried = (Tried("ramp over 25 steps", "acts", 20, 10, 0),)
    worse, same = Effect("stand", 20, 18, 9, 0, 9), Effect("run", 20, 18, 17, 1, 2)
    found = Remedies(
        "walk", "wave", 20, 10, tried, Effect("walk", 20, 9, 19, 10, 0), elsewhere=(worse, same)
    )
    assert found.harms == (worse,)
    assert "makes another pair worse, after stand: 18 of 20 without, 9 with it" in str(found)
    assert found.to_json()["elsewhere"][0]["lost"] == 9
    chance = Remedies("walk", "wave", 20, 10, tried, Effect("walk", 20, 12, 13, 2, 1))
    assert chance.best is None  # it was the best on the robots of the choice alone
    assert "None helps for certain" in str(chance)


def test_choices_and_models_that_have_no_mixture_are_left_out() -> None:
    def held(obs: Any) -> Any:
        return abs(obs[:, 2]) < 0.2

    skills = {
        "balance": lambda obs: (obs[:, 2] + 0.5 * obs[:, 3] > 0).astype(np.int64),
        "lean": lambda obs: (obs[:, 2] > 0).astype(np.int64),
    }
    found = sw.handovers("CartPole-v1", skills, steps=40, stays=held, calls=2, quiet=True)
    tried = found.remedies("balance", "lean", robots=3, quiet=True).tried
    assert [one.name for one in tried] == [
        "balance cut 5 steps later",
        "balance cut 10 steps later",
    ]


def test_ctrl_c_keeps_what_was_tried() -> None:
    asked = [0]

    def stays(obs: Any) -> Any:
        asked[0] += 1
        if asked[0] == 4_000:
            os.kill(os.getpid(), signal.SIGINT)
        return obs[:, 0] > -99

    skills = {"right": moving(0.1), "left": moving(-0.1)}
    found = sw.handovers(Line, skills, steps=20, stays=stays, calls=2, quiet=True)
    tried = found.remedies("right", "left", robots=200, quiet=True)
    assert tried.stopped
    assert 0 < tried.robots < 200
    assert tried.best is None
    assert "stopped" in str(tried)


def test_mistakes_end_in_a_sentence() -> None:
    found = measured("fast", "wave")
    with pytest.raises(DeclarationError, match=r"'wvae'.*wave"):
        found.remedies("fast", "wvae")
    with pytest.raises(DeclarationError, match="robots"):
        found.remedies("fast", "wave", robots=0)
    fast = policies()["fast"]
    with pytest.raises(DeclarationError, match="rename"):
        found.remedies("fast", "wave", instead={"ramp over 25 steps": fast})
    with pytest.raises(DeclarationError, match="instead"):
        found.remedies("fast", "wave", instead={"other": 3})
    with pytest.raises(DeclarationError, match="handovers"):
        MeasuredHandovers(("a", "b"), (), 1, (1, 1)).remedies("a", "b")


def test_a_motion_is_entered_at_other_steps_where_its_table_has_them() -> None:
    motion = sw.Table(np.arange(200.0), start=20)

    def entries(**how: Any) -> list[int]:
        return _entries(sw.from_function(driving, **how), 80)

    # Of a call of 80 steps an eighth and a quarter, earlier and later.
    assert entries(sees=(motion, "tilt")) == [-10, 10, -20, 20]
    assert entries(sees=(motion, "tilt"), entry=-15) == [-5, 5]
    assert entries(sees=(motion, "tilt"), entry=165) == [155, 175, 145]
    assert entries(sees=(sw.Elapsed(), "tilt")) == [10, 20]  # nobody knows what is before
    assert entries(sees=(sw.Elapsed(period=9), "tilt")) == []
    assert entries(sees="tilt") == []


def test_another_entry_may_help() -> None:
    """A motion whose first steps throw the robot over."""

    def tracking(x: Any) -> Any:
        return np.stack([x[:, :3] @ DRIVE[:3] + x[:, 3], np.full(len(x), 0.1)], axis=1)

    pushes = np.concatenate([np.full(10, 3.0), np.zeros(200)])
    sees = ("tilt", "gyro", "speed", sw.Table(pushes))
    skills = {"fast": policies()["fast"], "dance": sw.from_function(tracking, sees=sees)}
    found = sw.handovers(
        Balancer, skills, steps=80, stays=up, calls=1, vary=VARY, quiet=True
    ).remedies("fast", "dance", robots=8, quiet=True)
    best = next(one for one in found.tried if one.name == "entry at step 10")
    assert best.won == 8
    assert best.how == "entry=10 for the policy of 'dance'"
