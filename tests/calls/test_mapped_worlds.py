"""Policies from elsewhere, drawn by seed: their mappings mean what a reference in Python says."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls.users import plain
from calls.worlds import ACTIONS, OBSERVATIONS, as_action, choice_counts, numbers, width

import skillweave as sw
from skillweave.export.write import write_export
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.spaces import obs_dtype
from skillweave.types import Array

# Functions of the worlds choose at random, also what a mask forbids.
pytestmark = pytest.mark.filterwarnings("ignore:.*action mask forbids")
HOOK = sw.Part("hook", scale=2.0, offset=0.5, clip=(-1, 1))
GOAL = (0.25, -0.5)
STATES: dict[str, Any] = {
    "none": None,
    "rows first": (None, 2),
    "rows last": (2, None),
    "two": [(None, 2), (1, None)],
}
"""The shapes of recurrent states."""
SIZES = {"none": (), "rows first": (2,), "rows last": (2,), "two": (2, 1)}


@dataclass(frozen=True)
class Model:
    """A policy, and its mapping."""

    seed: int
    kind: str
    logits: bool
    """It returns scores of choices, as networks do."""
    named: bool
    """It has two inputs, with names."""
    goal: bool
    last: bool
    """It sees its last output."""
    every: int
    chunk: int | None
    state: str
    acts: str
    """"as they are"; "scaled"; "part": some of the numbers, or of the choices."""

    @property
    def space(self) -> Any:
        return ACTIONS[self.kind]

    @property
    def outputs(self) -> int:
        """The numbers of an output."""
        return 2 if self.acts == "part" else width(self.space)

    @property
    def mapping(self) -> dict[str, Any]:
        """What is declared."""
        beside = [*([sw.LastAction(scale=0.5)] if self.last else []), *([sw.Goal()] * self.goal)]
        whole: Any = ("arm", HOOK, "mode", *beside)
        scaled = {"scale": 0.5, "offset": 0.25, "clip": (-0.75, 0.5)} if self.kind == "box" else {}
        acts = {
            "as they are": None,
            "scaled": sw.Acts(**scaled),
            "part": sw.Acts(to=(2, 0), **scaled, **({"rest": 0.5} if self.kind == "box" else {})),
        }
        return {
            "sees": {"a": ("arm", HOOK), "b": ("mode", *beside)} if self.named else whole,
            "goal": GOAL if self.goal else None,
            "acts": acts[self.acts],
            "every": self.every,
            "chunk": self.chunk,
            "state": STATES[self.state],
        }

    def answer(self, inputs: dict[str, Array], states: list[Array]) -> tuple[Array, list[Array]]:
        """The outputs for n inputs, and the next states; states (n, k)."""
        given = [(name, x.astype(np.float64)) for name, x in inputs.items()]
        given += [(f"state {i}", x) for i, x in enumerate(states)]
        n, count = len(given[0][1]), self.chunk or 1
        found = numbers(f"model {self.seed}", given, count * self.outputs)
        found = found.reshape(n, count, self.outputs)
        if self.kind != "box" and not self.logits:  # a function returns choices
            counts = [self.outputs] if self.kind == "one" else choice_counts(self.space)
            parts = np.split(found, np.cumsum(counts)[:-1], axis=2)
            found = np.stack([part.argmax(axis=2) for part in parts], axis=2)
            if self.kind == "one":
                found = found[..., 0] + (self.space.start if self.acts != "part" else 0)
        elif self.acts == "as they are" and self.kind == "box":
            found = found.astype(np.float32)
        after = [x + numbers(f"state {self.seed}", given, x.shape[1]) for x in states]
        return (found if self.chunk else found[:, 0]), after

    def policy(self) -> ScriptedPolicy:
        """The policy in the library's terms."""
        shapes = STATES[self.state] or []
        shapes = shapes if isinstance(shapes, list) else [shapes]

        def turned(states: Any) -> list[Array]:
            """States with the rows first, or back."""
            pairs = zip(states, shapes, strict=True)
            return [x.T if shape[0] is not None else x for x, shape in pairs]

        def call(inputs: dict[str, Array], state: Any = None) -> Any:
            if state is None:
                return self.answer(inputs, [])[0]
            one = self.state != "two"
            output, after = self.answer(inputs, turned([state] if one else state))
            return output, turned(after)[0] if one else tuple(turned(after))

        functions = {
            (False, False): lambda x: call({"": x}),
            (False, True): lambda x, state: call({"": x}, state),
            (True, False): lambda a, b: call({"a": a, "b": b}),
            (True, True): lambda a, b, state: call({"a": a, "b": b}, state),
        }
        function = functions[self.named, self.state != "none"]
        made = sw.from_function(function, **self.mapping)
        made.logits = self.logits
        return made.bind(OBSERVATIONS, self.space, "it")


def model(seed: int) -> Model:
    """The model of a seed."""
    rng = np.random.default_rng(seed)

    def of(*values: Any) -> Any:
        return values[int(rng.integers(len(values)))]

    kind = of("box", "box", "several", "one")
    acts = {"box": ("as they are", "scaled", "part"), "one": ("as they are", "part")}
    return Model(
        seed, kind, kind != "box" and of(True, False), of(True, False), of(True, False),
        kind == "box" and of(True, False), of(1, 1, 2, 3), of(None, None, 2, 3), of(*STATES),
        of(*acts.get(kind, ("as they are",))),
    )  # fmt: skip


@dataclass
class Plain:
    """The policy in one environment."""

    model: Model
    ahead: list[Any] = field(default_factory=list)
    """The actions that follow without another inference."""

    def __post_init__(self) -> None:
        self.states = [np.zeros((1, n)) for n in SIZES[self.model.state]]
        self.last = np.zeros(2 if self.model.acts == "part" else 3)

    def act(self, obs: dict[str, Any], mask: Array | None) -> Any:
        if not self.ahead:
            self.infer(obs, mask)
        return self.ahead.pop(0)

    def infer(self, obs: dict[str, Any], mask: Array | None) -> None:
        model = self.model
        a = [obs["arm"], np.clip((obs["hook"].astype(np.float64) - 0.5) * 2, -1, 1)]
        b = [np.eye(3)[obs["mode"]]]
        b += [self.last * 0.5] if model.last else []
        b += [np.array(GOAL)] if model.goal else []
        both = {"a": a, "b": b} if model.named else {"": a + b}
        inputs = {name: np.concatenate(parts)[None] for name, parts in both.items()}
        output, self.states = model.answer(inputs, self.states)
        for i, one in enumerate(output[0] if model.chunk else output):
            action = self.meant(one, mask if i == 0 else None)  # no one knows later masks
            self.ahead += [action] * model.every

    def meant(self, output: Any, mask: Array | None) -> Any:
        """The action that an output means."""
        model, space = self.model, self.model.space
        part = model.acts == "part"
        if model.kind == "box":
            if model.acts == "as they are":
                self.last = np.float64(output)
                return output
            self.last = np.clip(output, -0.75, 0.5)
            numbers = self.last * 0.5 + 0.25
            whole = np.array([numbers[1], 0.5, numbers[0]]) if part else numbers
            return whole.astype(np.float32)
        if model.logits and part:
            allowed = np.ones(2, bool) if mask is None else mask[[2, 0]]
            output = np.where(allowed, output, -np.inf).argmax()
        elif model.logits:
            return as_action(output[None], space, None if mask is None else mask[None])[0]
        return (2, 0)[int(output)] + space.start if part else output


def moments(kind: str, seed: int, count: int) -> list[tuple[dict[str, Any], Array | None]]:
    """Observations, and masks of actions."""
    rng, found = np.random.default_rng(seed), []
    for t in range(count):
        obs = {"arm": rng.uniform(-2, 2, 2), "hook": rng.uniform(-2, 2, 1), "mode": t % 3}
        obs = {k: v if k == "mode" else np.asarray(v, np.float32) for k, v in obs.items()}
        mask = None
        if kind != "box":
            mask = np.ones(width(ACTIONS[kind]), bool)
            mask[int(rng.integers(2))] = False
        found.append((obs, mask))
    return found


def check(seed: int, folder: Path, seen: Counter[str]) -> None:
    """The policy acts as the reference: in rows, exported, and read again."""
    drawn = model(seed)
    seen.update(f"{f.name}: {getattr(drawn, f.name)}" for f in fields(drawn)[1:])
    policy = drawn.policy()
    in_rows(drawn, policy)
    if not drawn.logits:  # what is read is a function, which returns choices
        export = write_export(folder, policy, "crane")
        in_rows(drawn, sw.load_policy(folder, code=export.functions))
        runner_alone(drawn, folder, export.functions)


def in_rows(drawn: Model, policy: Any) -> None:
    """Some of the environments act at a time."""
    n, rng = 4, np.random.default_rng(drawn.seed)
    ones = [Plain(drawn) for _ in range(n)]
    every, memory = [moments(drawn.kind, i, 12) for i in range(n)], policy.start(n)
    for t in range(12):
        rows = np.flatnonzero(rng.random(n) < 0.7)
        if not len(rows):
            continue
        obs = np.zeros(len(rows), obs_dtype(OBSERVATIONS))
        for k, i in enumerate(rows):
            for name, value in every[i][t][0].items():
                obs[name][k] = value
        masks = [every[i][t][1] for i in rows]
        mask = None if masks[0] is None else np.array(masks)
        action, after = policy.act({k: v[rows] for k, v in memory.items()}, obs, mask)
        for k, v in after.items():
            memory[k][rows] = v
        wanted = [plain(ones[i].act(*every[i][t])) for i in rows]
        assert plain(action) == wanted, f"step {t}"


def runner_alone(drawn: Model, folder: Path, functions: dict[str, Any]) -> None:
    """One observation at a time, without this library."""
    pytest.importorskip("onnxruntime")
    from skillweave.export.runner import Runner

    runner = Runner(folder, functions)
    for episode in range(2):
        runner.reset()
        one = Plain(drawn)
        for obs, mask in moments(drawn.kind, 10 + episode, 10):
            info = {} if mask is None else {"action_mask": mask}
            assert plain(runner.act(obs, info=info)) == plain(one.act(obs, mask))


def test_policies_from_elsewhere_act_as_the_reference_says(tmp_path: Path) -> None:
    seen: Counter[str] = Counter()
    for seed in range(50):
        check(seed, tmp_path / str(seed), seen)
    assert min(seen.values()) > 3
    assert len(seen) == 3 + 4 * 2 + 3 + 3 + 4 + 3  # all values of all fields


@pytest.mark.slow
@pytest.mark.parametrize("first", range(50, 1_000, 190))
def test_many_more_policies_from_elsewhere_do(first: int, tmp_path: Path) -> None:
    for seed in range(first, first + 190):
        check(seed, tmp_path / str(seed), Counter())
