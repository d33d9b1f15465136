"""Ramps, cross-fades, held numbers and what begins anew, drawn by seed: as plain Python says it."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from calls.beside_plain import NAMES, check_beside, hierarchy, in_log
from calls.worlds import OBSERVATIONS, crane, numbers

import skillweave as sw
from skillweave.errors import DeclarationError, PolicyError
from skillweave.types import Array

HOME = np.array([0.25, -0.5])


@dataclass(frozen=True)
class Drawn:
    """A skill: what its policy sees and remembers, and how it takes over."""

    seed: int
    name: str
    ramp: int
    fade: Any
    """None, a number, or numbers by the name of the skill before."""
    held: tuple[int, ...]
    held_at: float | None
    anew: tuple[str, ...]
    every: int
    call_steps: int | None

    def answer(self, inputs: Array, state: Array) -> tuple[Array, Array]:
        """Outputs (n, 3) for inputs (n, K) and states (n, 2), and the next states."""
        given = [("x", inputs.astype(np.float64)), ("state", state)]
        name = f"{self.seed} {self.name}"
        return numbers(name, given, 3), state + numbers(f"{name} state", given, 2)

    def fades(self, before: str) -> int:
        if isinstance(self.fade, dict):
            return self.fade.get(before, 0)
        return self.fade or 0

    def skill(self) -> sw.Skill:
        """It in the library's terms."""
        arm = sw.Part("arm", offset=HOME, scale=2.0)
        if self.held:
            at = self.held_at
            arm = sw.Part("arm", offset=HOME, scale=2.0, held=self.held, held_at=at)
        policy = sw.from_function(
            self.answer,
            sees=(arm, "hook", sw.LastAction(scale=0.5)),
            acts=sw.Acts(scale=0.5, offset=0.25, clip=(-0.75, 0.5), ramp=self.ramp),
            state=(None, 2),
            every=self.every,
            anew=self.anew,
        )
        attributes = {"policy": policy, "fade": self.fade, "call_steps": self.call_steps}
        made: sw.Skill = type(self.name, (sw.Skill,), attributes)()
        return made


def drawn(seed: int) -> list[Drawn]:
    """The skills of a seed."""
    rng = np.random.default_rng(seed)

    def of(*values: Any) -> Any:
        return values[int(rng.integers(len(values)))]

    def skill(name: str) -> Drawn:
        others = [other for other in NAMES if other != name]
        fade = of(None, None, 1, 3, 6, {others[0]: 4}, {others[0]: 2, others[1]: 5})
        held = of((), (), (0,), (1,), (0, 1))
        ramp, held_at, every = of(0, 0, 1, 3, 5), of(None, 0.0, 0.7), of(1, 1, 3)
        names = ("state", "last_action", "held")[: 2 + (every > 1)]
        anew = tuple(x for x in names if rng.random() < 0.3)
        return Drawn(seed, name, ramp, fade, held, held_at, anew, every, of(None, None, 2))

    return [skill(name) for name in NAMES]


def between(before: Array, action: Array, share: float) -> Array:
    """Return ``share`` of an action (3,), and the rest of the one before."""
    mixed = share * action.astype(np.float64) + (1 - share) * before.astype(np.float64)
    return mixed.astype(np.float32)


class Alone:
    """A skill's policy in one environment, with its memory."""

    def __init__(self, skill: Drawn) -> None:
        self.skill = skill
        self.fresh()

    def fresh(self) -> None:
        self.state, self.last = np.zeros(2), np.zeros(3)
        self.ahead: list[Array] = []
        self.left: int | None = None

    def again(self) -> None:
        if "state" in self.skill.anew:
            self.state = np.zeros(2)
        if "last_action" in self.skill.anew:
            self.last = np.zeros(3)
        if "held" in self.skill.anew:
            self.ahead = []

    def act(self, obs: dict[str, Any], executed: Array | None) -> Array:
        skill = self.skill
        if not self.ahead:
            arm = obs["arm"].astype(np.float64)
            for place in skill.held:
                arm[place] = HOME[place] if skill.held_at is None else skill.held_at
            x = np.concatenate([(arm - HOME) * 2, obs["hook"], self.last * 0.5])
            output, state = skill.answer(x[None], self.state[None])
            self.state, self.last = state[0], np.clip(output[0], -0.75, 0.5)
            self.ahead = [(self.last * 0.5 + 0.25).astype(np.float32)] * skill.every
        action = self.ahead.pop(0)
        if self.left is None:
            self.left = skill.ramp if executed is not None else 0
            self.origin = executed
        if self.left > 0:
            share = (skill.ramp - self.left + 1) / skill.ramp
            if share < 1:
                action = between(self.origin, action, share)
            self.left -= 1
        return action


class Plain:
    """An episode of the whole."""

    def __init__(self, skills: list[Drawn], seen: Counter[str]) -> None:
        self.skills, self.seen = skills, seen
        self.alone = [Alone(skill) for skill in skills]
        self.running, self.before, self.faded = -1, -1, 0
        self.executed: Array | None = None

    def act(self, obs: dict[str, Any], choice: int | None) -> Array:
        """The action; ``choice``: a call starts."""
        if choice is not None and choice == self.running:
            self.alone[choice].again()
            self.seen["again"] += 1
            self.seen["again while the other fades"] += self.before >= 0
        elif choice is not None:
            steps = 0
            if self.running >= 0:
                steps = self.skills[choice].fades(self.skills[self.running].name)
            self.seen["cut while another fades"] += self.before >= 0
            self.before = self.running if steps > 1 else -1
            self.running, self.faded = choice, 0
            self.alone[choice].fresh()
        skill = self.alone[self.running]
        self.seen["ramp"] += bool(skill.left)
        action = skill.act(obs, self.executed)
        if self.before >= 0:
            self.faded += 1
            steps = self.skills[self.running].fades(self.skills[self.before].name)
            share = self.faded / steps
            if share < 1:
                theirs = self.alone[self.before].act(obs, self.executed)
                action = between(theirs, action, share)
                self.seen["fade"] += 1
                self.seen["both"] += bool(skill.left)
            else:
                self.before = -1
        self.executed = action
        return action


def check(seed: int, folder: Path, seen: Counter[str]) -> None:
    skills = drawn(seed)
    check_beside(seed, folder, skills, lambda: Plain(skills, seen))
    # As the run records it.
    recorded = sw.Hierarchy.from_manifest(json.loads((folder / "run/run.json").read_text()))
    assert [s.fade for s in recorded.skills] == [s.fade for s in skills]


def test_soft_switches_act_as_the_reference_says(tmp_path: Path) -> None:
    seen: Counter[str] = Counter()
    for seed in range(12):
        check(seed, tmp_path / str(seed), seen)
    assert min(seen.values()) > 3
    assert len(seen) == 6


@pytest.mark.slow
def test_many_more_soft_switches_do(tmp_path: Path) -> None:
    for seed in range(12, 80):
        check(seed, tmp_path / str(seed), Counter())


def test_they_hold_in_training_too(tmp_path: Path) -> None:
    """Where a selector learns above such skills, what its log has is what they do."""
    for seed in range(4):
        skills = drawn(seed)
        ppo = sw.PPO(num_envs=3, n_steps=24)
        learning = sw.Hierarchy(
            crane("box", False), [s.skill() for s in skills], call_steps=3, selector=ppo, steps=72
        )
        run = learning.train(tmp_path / str(seed), quiet=True, log_calls=200)
        assert len(run.calls) > 20
        in_log(run.calls, lambda skills=skills: Plain(skills, Counter()))


def test_a_correction_learns_on_a_policy_with_a_ramp(tmp_path: Path) -> None:
    class Still(sw.Skill):
        policy = sw.from_function(lambda obs: np.full((len(obs), 3), 0.5))

    class Ramped(sw.Skill):
        policy = sw.Residual(
            sw.from_function(
                lambda x: np.zeros((len(x), 3)), sees="arm", acts=sw.Acts(ramp=4)
            ),
            scale=0.1,
        )  # fmt: skip

    ppo = sw.PPO(num_envs=2, n_steps=16)
    made = sw.Hierarchy(
        crane("box", False), [Still(), Ramped()], call_steps=4, steps=64, algorithm=ppo,
        selector=lambda obs: np.where(obs["mode"] == 0, "still", "ramped"),
    )  # fmt: skip
    run = made.train(tmp_path / "run", quiet=True, log_calls=100)
    log = run.calls
    after = np.flatnonzero((log.skill == 1) & (log.order > 0))
    assert len(after)
    half = (made.spec.spaces.action.high - made.spec.spaces.action.low) / 2
    for call in after:
        before = np.flatnonzero(log.followed_by == call)
        if not len(before) or log.skill[before[0]] == 1:
            continue
        last = log.action[log.offset[before[0] + 1] - 1]
        steps = log.action[log.offset[call] : log.offset[call + 1]]
        for k, action in enumerate(steps):
            assert (abs(action - last * (1 - (k + 1) / 4)) <= 0.1 * half + 1e-6).all()


def test_a_run_keeps_the_fade_with_which_it_was_made(tmp_path: Path) -> None:
    skills = drawn(0)
    made = hierarchy(0, skills).train(tmp_path / "run", quiet=True)
    other = hierarchy(0, [replace(skill, fade=9) for skill in skills])
    with pytest.warns(UserWarning, match="fade of skill 'a' is .* 9"):
        loaded = sw.load(tmp_path / "run", other)
    assert loaded.policy.source() == made.policy.source()  # type: ignore[attr-defined]
    assert [skill.fade for skill in loaded.hierarchy.skills] == [skill.fade for skill in skills]


def test_numbers_that_are_held_stand_where_they_are_named() -> None:
    def seen(part: sw.Part) -> Any:
        shown: list[Any] = []
        policy = sw.from_function(lambda x: shown.append(x.copy()) or x[:, :1], sees=(part,))
        box = gym.spaces.Box(-99, 99, (4,), np.float32)
        bound = policy.bind(box, gym.spaces.Box(-99, 99, (1,), np.float32), "it")
        bound.act(bound.start(1), np.float32([[10, 11, 12, 13]]))
        return shown[-1][0].tolist()

    assert seen(sw.Part(held=(3, 1), held_at=(3.0, 1.0))) == [10, 1, 12, 3]
    assert seen(sw.Part(places=(3, 0), held=(3, 1), held_at=(3.0, 1.0))) == [3, 10]
    assert seen(sw.Part(held=(2,), offset=(1, 2, 3, 4))) == [9, 9, 0, 9]
    assert seen(sw.Part(held=slice(1, 3), held_at=0.0, scale=2.0)) == [20, 0, 0, 26]


def skill_with(**attributes: Any) -> sw.Skill:
    still = sw.from_function(lambda obs: np.zeros((len(obs), 3), np.float32))
    made: sw.Skill = type("it", (sw.Skill,), {"policy": still} | attributes)()
    return made


WRONG: dict[str, tuple[dict[str, Any], str, type[Exception], str]] = {
    "a name": ({"fade": {"wlak": 3}}, "box", DeclarationError, "fade names 'wlak'"),
    "no number": ({"fade": "long"}, "box", DeclarationError, "fade"),
    "zero": ({"fade": 0}, "box", DeclarationError, "fade"),
    "it learns": ({"fade": 3, "policy": None}, "box", DeclarationError, "learns"),
    "choices": (
        {"fade": 3, "policy": sw.from_function(lambda obs: np.full(len(obs), 2))},
        "one", DeclarationError, "Box",
    ),
    "a ramp of choices": (
        {"policy": sw.from_function(lambda x: np.full(len(x), 2), sees="arm",
                                    acts=sw.Acts(ramp=3))},
        "one", PolicyError, "ramp",
    ),
    "held where": (
        {"policy": sw.from_function(lambda x: x, sees=sw.Part("arm", held=(5,)))},
        "box", PolicyError, "held",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_mistakes_end_in_a_sentence(case: str) -> None:
    attributes, kind, error, words = WRONG[case]
    other = {"policy": None} if kind == "one" else {}
    skills = [skill_with(**attributes), skill_with(name="other", **other)]
    with pytest.raises(error, match=words):
        sw.Hierarchy(crane(kind, False), skills).train(quiet=True)


def test_wrong_words_are_refused_where_they_are_written() -> None:
    with pytest.raises(DeclarationError, match="ramp"):
        sw.Acts(ramp=-1)
    with pytest.raises(DeclarationError, match="anew"):
        sw.from_function(lambda x: x, anew="clock")
    with pytest.raises(DeclarationError, match="anew names 'state'"):
        sw.from_function(lambda x: x, anew="state")
    with pytest.raises(DeclarationError, match="held_at"):
        sw.Part("arm", held_at=0.0)
    assert OBSERVATIONS["arm"].shape == HOME.shape
