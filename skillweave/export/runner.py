"""Acts by a policy that Skillweave exported; needs NumPy and onnxruntime, and nothing else.

    runner = Runner("lander-onnx", code={"engines off.condition": landed})
    runner.reset()                     # at the start of every episode
    action = runner.act(observation)   # at every step

Networks are ONNX files; which skill acts, how long its call lasts and who follows stands in
``policy.json``. What was Python code is given by name; it sees one observation as a batch of one.
"""

from __future__ import annotations

import json
from functools import reduce
from operator import getitem
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnxruntime as ort

RUNNING, OWN, LIMIT, INTERRUPTED, EPISODE = range(5)  # why a call is over


class Runner:
    """The policy of one environment; ``code``, or ``hierarchy``, has the functions it needs."""

    def __init__(self, path: Any, code: Any = None, hierarchy: Any = None, seed: Any = None):
        self.path, self.code, self.rng = Path(path), dict(code or {}), np.random.default_rng(seed)
        self.told = json.loads((self.path / "policy.json").read_text(encoding="utf-8"))
        self._take(hierarchy)
        needs = {k: v for k, v in self.told["code"].items() if not callable(self.code.get(k))}
        if needs:
            raise ValueError(f"{path} needs code: give Runner(code={{name: function}}) for {needs}")
        self.dtype, self.root = np.dtype(self.told["dtype"]), self.made(self.told["policy"])
        self.reset()

    def _take(self, owner: Any, path: str = "") -> None:
        """Take the functions of a hierarchy's skills and reflexes, and of hierarchies below."""
        skills = getattr(owner, "skills", ())
        owner = skills if hasattr(skills, "skills") else owner
        for part in (*getattr(owner, "skills", ()), *getattr(owner, "reflexes", ())):
            for method in ("initiation", "termination", "success", "condition", "action"):
                self.code.setdefault(f"{path}{part.name}.{method}", getattr(part, method, None))
            self._take(getattr(part, "policy", None), f"{path}{part.name}/")

    def reset(self) -> None:
        """A new episode begins."""
        self.before: Any = ()
        self.elapsed = 0
        self.root.reset()

    def act(self, obs: Any, reward: float = 0.0, info: Any = None, mask: Any = None) -> Any:
        """The action for an observation and what came with it; ``mask`` says which are allowed."""
        self.obs, self.feeds = np.zeros((1, *self.told["shape"]), self.dtype), {}
        for name, fields, keys in self.told["inputs"]:
            self.feeds[name] = reduce(getitem, fields, self.obs)
            self.feeds[name][0] = reduce(getitem, keys, obs)
        if self.before:
            self.elapsed += 1
            self.latest: Any = (*self.before, self.obs, np.float32(reward), info or {})
            self.root.observe(self.elapsed, False)
        action = self.root.act(None if mask is None else np.array(mask, bool)[None])
        self.before = self.obs, action
        return action

    def step(self, elapsed: int, timed_out: bool) -> Any:
        """The latest step, as seen by who has acted for ``elapsed`` steps: arrays of one row."""
        obs, action, after, reward, info = self.latest
        no, told = np.zeros(1, bool), {k: np.array([v]) for k, v in info.items()}
        rows = {"action": action, "reward": reward, "timed_out": timed_out, "elapsed": elapsed}
        found = {k: np.array([v]) for k, v in rows.items()} | {"obs": obs, "next_obs": after}
        return SimpleNamespace(**found, terminated=no, truncated=no, info=told)

    def made(self, told: Any) -> Any:
        """The part of the policy that an entry of ``policy.json`` describes."""
        kinds = {c.__name__: c for c in [_Code] + _Code.__subclasses__()}  # noqa: RUF005
        return kinds[f"_{told['kind']}"](self, told)

    def asks(self, name: str, about: Any) -> bool:
        """What code says of an observation or a step."""
        return bool(np.asarray(self.code[name](about))[0])

    def action(self, value: Any) -> Any:
        """An action that code gave, within its space."""
        space = self.told["action"]
        if space["low"] is not None:
            value = np.clip(value, np.array(space["low"]), np.array(space["high"]))
        return np.asarray(value, space["dtype"]).reshape(space["shape"])[()]


class _Code:
    """A skill's policy that is a function of observations; and what all parts have."""

    def __init__(self, runner: Runner, told: Any) -> None:
        self.runner, self.told = runner, told

    def reset(self) -> None: ...
    def observe(self, elapsed: int, timed_out: bool) -> None: ...
    def watch(self, last: Any, *when: Any) -> None: ...
    def act(self, mask: Any, last: Any = None) -> Any:
        return self.runner.action(self.runner.code[self.told["code"]](self.runner.obs)[0])


class _Network(_Code):
    """A graph from what is seen, perhaps a mask, a memory and noise, to what is done."""

    def __init__(self, runner: Runner, told: Any) -> None:
        super().__init__(runner, told)
        options, where = ort.SessionOptions(), {"providers": ["CPUExecutionProvider"]}
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self.session = ort.InferenceSession(str(runner.path / told["file"]), options, **where)
        self.outputs = [o.name for o in self.session.get_outputs()]
        self.reset()

    def reset(self) -> None:
        self.memory = {k: np.zeros((1, n), "f4") for k, n in self.told["memory"].items()}

    def act(self, mask: Any, last: Any = None) -> Any:
        feeds = self.runner.feeds | self.memory
        if self.told["choices"]:
            feeds["mask"] = np.ones((1, self.told["choices"]), bool) if mask is None else mask
        for i, (kind, n) in enumerate(self.told["noise"]):
            feeds[f"noise.{i}"] = getattr(self.runner.rng, kind)(size=(1, n)).astype(np.float32)
        action, *after = self.session.run(self.outputs, feeds)
        self.memory = dict(zip(self.memory, after, strict=True))
        return action[0]


class _Hierarchy(_Code):
    """A selector and its skills; the selector decides where a call is over."""

    def __init__(self, runner: Runner, told: Any) -> None:
        super().__init__(runner, told)
        self.selector, self.skills = runner.made(told["selector"]), told["skills"]
        self.guide = told.get("guide") and runner.made(told["guide"])
        self.policies = [runner.made(skill["policy"]) for skill in self.skills]
        self.critic = told["critic"] and runner.made(told["critic"])

    def reset(self) -> None:
        self.skill, self.why, self.succeeded = -1, EPISODE, False
        self.selector.reset()
        if self.guide:
            self.guide.reset()

    def may_start(self) -> Any:
        may = []
        for told, policy in zip(self.skills, self.policies, strict=True):
            code = told["initiation"]
            own = code is None or self.runner.asks(code, self.runner.obs)
            may.append(own and (not isinstance(policy, _Hierarchy) or policy.may_start().any()))
        return np.array(may)

    def allowed(self) -> Any:
        may = self.may_start()
        return self.guide.allowed(may[None], self) if self.guide and may.any() else may

    def act(self, mask: Any, last: Any = None) -> Any:
        lengths, runner = self.told["lengths"] or [np.inf], self.runner
        if self.why != RUNNING:
            if not (may := self.allowed().repeat(len(lengths))).any():
                raise ValueError(f"no skill may start in observation {runner.obs[0]}")
            skill, length = divmod(int(self.selector.act(may[None], self)), len(lengths))
            if skill != self.skill:
                self.policies[skill].reset()
            self.limit = min(lengths[length], self.skills[skill]["limit"] or np.inf)
            self.skill, self.elapsed, self.why = skill, 0, RUNNING
        action = self.policies[self.skill].act(mask)
        for condition, code, fixed in self.told["reflexes"]:
            if runner.asks(condition, runner.obs):
                action = runner.action(fixed if code is None else runner.code[code](runner.obs)[0])
        return action

    def observe(self, elapsed: int, timed_out: bool) -> None:
        runner, told, self.elapsed = self.runner, self.skills[self.skill], self.elapsed + 1
        own = self.elapsed, self.elapsed >= (told["max_steps"] or np.inf)
        self.why = LIMIT if self.elapsed >= self.limit else RUNNING
        (below := self.policies[self.skill]).observe(*own)
        if isinstance(below, _Hierarchy) and below.why != RUNNING and not below.may_start().any():
            self.why = LIMIT
        if told["termination"] and runner.asks(told["termination"], runner.step(*own)):
            self.why = OWN
        if self.critic and self.why == RUNNING:
            worth = self.critic.act(None)
            best = worth[self.may_start()].max(initial=-np.inf)
            self.why = INTERRUPTED if best - worth[self.skill] > self.told["margin"] else RUNNING
        judge, self.succeeded = told["success"], self.why == OWN
        if judge and self.why != RUNNING:
            self.succeeded = runner.asks(judge, runner.step(*own))
        self.selector.watch(self, elapsed, timed_out)
        if self.guide:
            self.guide.watch(self, elapsed, timed_out)


class _Function(_Code):
    """A selector that is a function of observations, and perhaps of how the last call ended."""

    def act(self, mask: Any, last: Any = None) -> Any:
        ended = {k: np.array([getattr(last, k)]) for k in ("skill", "why", "succeeded")}
        more = [SimpleNamespace(**ended)] * self.told["asks_last"]
        chosen = np.asarray(self.runner.code[self.told["code"]](self.runner.obs, *more))[0]
        return self.told["names"].index(chosen) if isinstance(chosen, str) else chosen

    def allowed(self, mask: Any, last: Any) -> Any:
        return np.arange(mask.shape[1]) == self.act(mask, last)


class _Automaton(_Code):
    """A selector of states: the skills of each, best first, and transitions by events."""

    def reset(self) -> None:
        self.state = self.told["start"]

    def act(self, mask: Any, last: Any = None) -> Any:
        return next(skill for skill in self.told["skills"][self.state] if mask[0, skill])

    def allowed(self, mask: Any, last: Any) -> Any:
        return mask[0] & np.isin(np.arange(mask.shape[1]), self.told["skills"][self.state])

    def watch(self, last: Any, *when: Any) -> None:
        asks, step = self.runner.asks, self.runner.step
        ended = {"success": last.succeeded, "failure": not last.succeeded}
        for origin, target, event, code in self.told["transitions"]:
            over = last.why != RUNNING and ended.get(event)
            if self.state == origin and (asks(code, step(*when)) if code else over):
                self.state = target
                return
