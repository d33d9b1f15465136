"""Clocks, tables, histories, ``call`` and first values, drawn by seed: as plain Python says it."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls.beside_plain import NAMES, check_beside, hierarchy, in_log
from calls.worlds import crane, numbers

import skillweave as sw
from skillweave.types import Array

onnx = pytest.importorskip("onnx")

pytestmark = pytest.mark.filterwarnings("ignore:.*its table was over")
TABLE = np.random.default_rng(5).uniform(-1, 1, (6, 3))
HOME = np.array([0.25, -0.5])


@dataclass(frozen=True)
class Term:
    """A part of ``sees``."""

    kind: str
    past: dict[str, Any]
    """Settings of its history; {}: none."""
    setting: Any = None

    def source(self) -> Any:
        """It in the library's terms."""
        match self.kind:
            case "arm":
                return sw.Part("arm", offset=HOME, scale=2.0, **self.past)
            case "hook":
                return sw.Part("hook", clip=(-0.5, 0.5), **self.past)
            case "goal":
                return sw.Goal(scale=0.5, **self.past)
            case "last":
                return sw.LastAction(scale=0.5, offset=0.125, **self.past)
            case "clock":
                return sw.Elapsed(scale=0.1, **self.setting)
            case "table":
                return sw.Table(TABLE, (2, 0), **self.setting)
        return since_entry

    def now(self, obs: Any, last: Array, steps: int, start: Any, entry: int) -> list[float]:
        """Its numbers in one inference."""
        match self.kind:
            case "arm":
                return [(float(x) - h) * 2.0 for x, h in zip(obs["arm"], HOME, strict=True)]
            case "hook":
                return [min(max(float(obs["hook"][0]), -0.5), 0.5)]
            case "goal":
                return [0.5 * (1.0 - float(obs["arm"][1]))]
            case "last":
                return [(x - 0.125) * 0.5 for x in last.tolist()]
            case "clock":
                found = []
                for first in np.atleast_1d(self.setting.get("first", 0.0)):
                    x, period = float(steps + first), self.setting.get("period")
                    if period is not None:
                        x %= period
                    wave = {"sin": np.sin, "cos": np.cos}.get(self.setting.get("wave"))
                    found.append(0.1 * (x if wave is None else wave(2.0 * np.pi / period * x)))
                return found
            case "table":
                at = self.setting.get("start", 0) + self.setting.get("rate", 1.0) * steps
                at = min(max(at, 0.0), 5.0)
                low = math.floor(at)
                high = min(low + 1, 5)
                row = TABLE[low] + (at - low) * (TABLE[high] - TABLE[low])
                return [row[2], row[0]]
        return [float(obs["hook"][0]) - float(start["hook"][0]), (steps - entry) / 8]


def aim(obs: Any) -> Array:
    """The goal: a number."""
    return 1.0 - obs["arm"][:, 1].astype(np.float64)


def since_entry(obs: Any, call: Any) -> Array:
    """How far the hook has moved since the skill took over, and for how long it has acted."""
    moved = obs["hook"].astype(np.float64) - call.start["hook"].astype(np.float64)
    return np.concatenate([moved, (call.steps[:, None] - call.entry) / 8], axis=1)


@dataclass(frozen=True)
class Drawn:
    """A skill: what its policy sees, and when it forgets."""

    seed: int
    name: str
    terms: tuple[Term, ...]
    anew: tuple[str, ...]
    every: int
    entry: int
    call_steps: int | None
    started: bool
    """It is an ONNX file whose state starts with a value; else a function."""

    def answer(self, inputs: Array) -> Array:
        """Outputs (n, 3) for inputs (n, K)."""
        return numbers(f"{self.seed} {self.name}", [("x", inputs.astype(np.float64))], 3)

    def skill(self) -> sw.Skill:
        """It in the library's terms."""
        sees = tuple(term.source() for term in self.terms)
        how: Any = {"goal": aim if any(t.kind == "goal" for t in self.terms) else None}
        how |= {"acts": sw.Acts(scale=0.5, offset=0.25), "every": self.every, "anew": self.anew}
        how |= {"entry": self.entry}
        if self.started:
            policy: Any = sw.from_onnx(
                FILE, sees={"x": sw.Part("arm", history=2)}, output="y",
                state={"t": ("t_next", 3.0), "v": ("v_next", [0.5, -0.25])},
                acts=sw.Acts(), every=self.every, anew=self.anew,
            )  # fmt: skip
        else:
            policy = sw.from_function(self.answer, sees=sees, **how)
        attributes = {"policy": policy, "call_steps": self.call_steps}
        made: sw.Skill = type(self.name, (sw.Skill,), attributes)()
        return made


def write_file(path: Path) -> None:
    """Write a model whose state goes on from a value: a counter, and a vector that halves."""
    helper, real = onnx.helper, onnx.TensorProto.FLOAT

    def value(name: str, *shape: Any) -> Any:
        return helper.make_tensor_value_info(name, real, shape)

    nodes = [
        helper.make_node("Slice", ["x", "zero", "three", "one"], ["some"]),
        helper.make_node("Mul", ["some", "half"], ["scaled"]),
        helper.make_node("Concat", ["t", "v"], ["state"], axis=1),
        helper.make_node("Mul", ["state", "half"], ["shift"]),
        helper.make_node("Add", ["scaled", "shift"], ["y"]),
        helper.make_node("Add", ["t", "half"], ["t_next"]),
        helper.make_node("Mul", ["v", "half"], ["v_next"]),
    ]
    known = [
        helper.make_tensor(name, onnx.TensorProto.INT64, [1], [number])
        for name, number in (("zero", 0), ("three", 3), ("one", 1))
    ]
    known.append(helper.make_tensor("half", real, [1], [0.5]))
    inputs = [value("x", 1, 4), value("t", 1, 1), value("v", 1, 2)]
    outputs = [value("y", 1, 3), value("t_next", 1, 1), value("v_next", 1, 2)]
    graph = helper.make_graph(nodes, "started", inputs, outputs, known)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, str(path))


FILE = Path()
"""Of the model with a state; the fixture writes it."""


@pytest.fixture(autouse=True)
def _file(tmp_path: Path) -> None:
    global FILE
    FILE = tmp_path / "started.onnx"
    write_file(FILE)


def drawn(seed: int) -> list[Drawn]:
    """The skills of a seed."""
    rng = np.random.default_rng(seed)

    def of(*values: Any) -> Any:
        return values[int(rng.integers(len(values)))]

    def past() -> dict[str, Any]:
        if rng.random() < 0.4:
            return {}
        order = of("oldest", "newest")
        return {"history": of(2, 3, 5), "fill": of("first", "zeros"), "order": order}

    def terms() -> tuple[Term, ...]:
        joined = {"history": of(2, 3), "order": of("oldest", "newest"), "layout": "step"}
        several = [Term(kind, past()) for kind in ("arm", "hook", "goal", "last")]
        if rng.random() < 0.4:
            several[1:3] = [
                Term(t.kind, joined | {"fill": of("first", "zeros")}) for t in several[1:3]
            ]
        clock = of({}, {"first": (0, 2)}, {"period": 4, "wave": "sin", "first": 1},
                   {"period": 2.5, "wave": "cos", "first": (0.5, 1)}, {"period": 3})  # fmt: skip
        table = of({}, {"start": 2}, {"rate": 0.5}, {"rate": 1.5, "start": -1})
        timed = [Term("clock", {}, clock), Term("table", {}, table), Term("call", {})]
        kept = [term for term in timed if rng.random() < 0.6]
        first, cut = several[:1], int(rng.integers(2)) * 3
        return tuple([*first, *kept, *several[1:]] if cut else [*several, *kept])

    def skill(name: str) -> Drawn:
        found = terms()
        every, started = of(1, 1, 2), rng.random() < 0.2
        timed = any(t.kind in ("clock", "table", "call") for t in found) and not started
        long = started or any("history" in t.past for t in found)
        names = ["elapsed"] * timed + ["history"] * long + ["held"] * (every > 1)
        names += ["state"] if started else ["last_action"]
        anew = tuple(x for x in names if rng.random() < 0.3)
        entry = of(0, 0, 2) if timed else 0
        return Drawn(seed, name, found, anew, every, entry, of(None, None, 2), started)

    return [skill(name) for name in NAMES]


class Alone:
    """A skill's policy in one environment, with its memory."""

    def __init__(self, skill: Drawn, seen: Counter[str]) -> None:
        self.skill, self.seen = skill, seen
        self.fresh()

    def fresh(self) -> None:
        self.last, self.ahead = np.zeros(3), list[Array]()
        self.steps, self.start = self.skill.entry, None
        self.past: list[list[list[float]]] = []
        self.t, self.v = np.float32(3.0), np.float32([0.5, -0.25])

    def again(self) -> None:
        anew = self.skill.anew
        if "last_action" in anew:
            self.last = np.zeros(3)
        if "held" in anew:
            self.ahead = []
        if "elapsed" in anew:
            self.steps, self.start = self.skill.entry, None
        if "history" in anew:
            self.past = []
        if "state" in anew:
            self.t, self.v = np.float32(3.0), np.float32([0.5, -0.25])

    def input(self, obs: Any) -> Array:
        """What its policy is shown."""
        skill = self.skill
        given = obs, self.last, self.steps, self.start, skill.entry
        self.past.append([term.now(*given) for term in skill.terms])
        found: list[float] = []
        joined: list[int] = []
        for i, term in enumerate(skill.terms):
            layout = term.past.get("layout", "term")
            if layout == "step":
                joined.append(i)
                after = skill.terms[i + 1 : i + 2]
                if after and after[0].past.get("layout") == "step":
                    continue
            places, joined = joined or [i], []
            ages = list(range(term.past.get("history", 1)))
            if term.past.get("order", "oldest") == "oldest":
                ages.reverse()
            for age in ages:
                for place in places:
                    found += self.before(place, age)
        return np.array(found)

    def before(self, place: int, age: int) -> list[float]:
        """The numbers of a term, ``age`` inferences ago."""
        if age < len(self.past):
            return self.past[-1 - age][place]
        first = self.past[0][place]
        zeros = self.skill.terms[place].past.get("fill", "first") == "zeros"
        self.seen["zeros" if zeros else "first"] += 1
        return [0.0] * len(first) if zeros else first

    def act(self, obs: dict[str, Any]) -> Array:
        skill = self.skill
        if self.start is None:
            self.start = obs
        if not self.ahead:
            action = self.started(obs) if skill.started else self.called(obs)
            self.ahead = [action] * skill.every
        self.steps += 1
        for term in skill.terms if not skill.started else ():
            self.seen[term.kind] += 1
        return self.ahead.pop(0)

    def called(self, obs: dict[str, Any]) -> Array:
        self.last = self.skill.answer(self.input(obs)[None])[0]
        return clipped(self.last * 0.5 + 0.25)

    def started(self, obs: dict[str, Any]) -> Array:
        self.seen["started"] += 1
        self.past.append([obs["arm"].astype(np.float64)])
        before = self.past[-2] if len(self.past) > 1 else self.past[0]
        x = np.concatenate([before[0], self.past[-1][0]]).astype(np.float32)
        half = np.float32(0.5)
        y = x[:3] * half + np.concatenate([[self.t], self.v]).astype(np.float32) * half
        self.t, self.v = np.float32(self.t + half), self.v * half
        return clipped(y)


def clipped(action: Array) -> Array:
    return np.clip(action, [-1, -1, -1], [1, 1, 3]).astype(np.float32)


class Plain:
    """An episode of the whole."""

    def __init__(self, skills: list[Drawn], seen: Counter[str]) -> None:
        self.alone = [Alone(skill, seen) for skill in skills]
        self.running, self.seen = -1, seen

    def act(self, obs: dict[str, Any], choice: int | None) -> Array:
        """The action; ``choice``: a call starts."""
        if choice is not None and choice == self.running:
            self.alone[choice].again()
            self.seen["again"] += 1
        elif choice is not None:
            self.alone[choice].fresh()
            self.running = choice
        return self.alone[self.running].act(obs)


def check(seed: int, folder: Path, seen: Counter[str]) -> None:
    skills = drawn(seed)
    check_beside(seed, folder, skills, lambda: Plain(skills, seen))
    # A run keeps the mappings, and restores them.
    kept = sw.load(folder / "run", hierarchy(seed, skills)).hierarchy
    again = [s.policy.mapping for s in kept.skills]  # type: ignore[union-attr]
    assert again == [s.skill().policy.mapping for s in skills]  # type: ignore[union-attr]


def test_time_and_history_are_as_the_reference_says(tmp_path: Path) -> None:
    seen: Counter[str] = Counter()
    for seed in range(12):
        check(seed, tmp_path / str(seed), seen)
    assert min(seen.values()) > 3
    kinds = "arm hook goal last clock table call first zeros started again"
    assert set(seen) == set(kinds.split())


@pytest.mark.slow
def test_more_times_and_histories_are(tmp_path: Path) -> None:
    for seed in range(12, 80):
        check(seed, tmp_path / str(seed), Counter())


def test_they_are_in_training_too(tmp_path: Path) -> None:
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
