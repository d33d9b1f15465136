"""Act by a policy that Skillweave exported; needs NumPy and onnxruntime, and nothing else.

    runner = Runner("lander-onnx", code={"engines off.condition": landed})
    runner.reset()                     # at the start of every episode
    action = runner.act(observation)   # at every step

Python code is given by name; it receives one observation as a batch of one.
"""

import json
from contextlib import suppress
from functools import reduce
from operator import getitem
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnxruntime as ort

RUNNING, OWN, LIMIT, INTERRUPTED, EPISODE = range(5)  # how a call has ended
TRIES = 16  # the most choices for a call, where the goals of those before hold already
DTYPES = {  # of inputs, by ONNX's names
    "float": "f4",
    "double": "f8",
    "float16": "f2",
    "int64": "i8",
    "int32": "i4",
    "int16": "i2",
    "int8": "i1",
    "uint16": "u2",
    "uint8": "u1",
}


class Runner:
    """The policy of one environment; ``code`` has the functions that ``policy.json`` lists."""

    def __init__(self, path: Any, code: Any = None, seed: Any = None):
        self.path = Path(path)
        self.code = code or {}
        self.rng = np.random.default_rng(seed)
        self.entry = json.loads((self.path / "policy.json").read_text(encoding="utf-8"))
        if needs := {k: v for k, v in self.entry["code"].items() if k not in self.code}:
            raise ValueError(f"{path} needs code: give Runner(code={{name: function}}) for {needs}")
        self.dtype, self.space = np.dtype(self.entry["dtype"]), self.entry["action_space"]
        self.root = self.made(self.entry["policy"])
        self.reset()

    def reset(self) -> None:
        """Start a new episode."""
        self.before, self.elapsed = dict[str, Any](), 0
        self.root.reset()

    def act(self, obs: Any, reward: float = 0.0, info: Any = None, mask: Any = None) -> Any:
        """Return the action for an observation; ``mask`` marks the actions that are allowed."""
        self.obs = np.zeros((1, *self.entry["shape"]), self.dtype)
        self.feeds, self.goal = dict[str, Any](), None
        for name, fields, keys in self.entry["inputs"]:
            part = self.feeds[name] = reduce(getitem, fields, self.obs)
            try:
                value = np.asarray(reduce(getitem, keys, obs))
                if value.shape != part.shape[1:]:
                    raise ValueError(f"it has shape {value.shape}, not {part.shape[1:]}")
                part[0] = value
            except (KeyError, IndexError, TypeError, ValueError) as error:
                what = "".join(f"[{key!r}]" for key in keys)
                raise ValueError(f"obs{what} does not fit policy.json: {error}") from error
        if self.before:
            self.elapsed += 1
            rows = {k: np.array([v]) for k, v in (info or {}).items()}
            self.latest = self.before | {"next_obs": self.obs, "info": rows}
            self.latest["reward"] = np.array([reward], np.float32)
            self.root.observe(self.elapsed, False)
        if mask is None:
            mask = (info or {}).get("action_mask")
        if mask is None and self.entry["observed_mask"]:
            mask = np.ravel(obs["action_mask"])
        action = self.root.act(None if mask is None else np.array(mask, bool)[None])
        self.before = {"obs": self.obs, "action": np.array([action])}
        return action

    def step(self, elapsed: int, timed_out: bool, goal: Any = None) -> Any:
        """Return the latest step, in arrays of one row, for a part that began ``elapsed`` ago."""
        rows = {"elapsed": elapsed, "timed_out": timed_out, "terminated": False, "truncated": False}
        one = {k: np.array([v]) for k, v in rows.items()}
        return SimpleNamespace(**self.latest, **one, goal=goal)

    def seeing(self, goal: Any, entry: Any, act: Any) -> Any:
        """Return what a part does with a goal: in the observation (``joined``), or beside it."""
        before = self.obs, self.feeds, self.goal
        self.goal = goal
        if entry["joined"]:
            parts = {"observation": self.obs, "goal": goal}
            kind = [(k, x.dtype, x.shape[1:]) for k, x in parts.items()]
            self.obs = np.zeros(1, np.dtype(kind, align=True))
            for name, part in parts.items():
                self.obs[name] = part
            self.feeds = {f"obs.observation{k[3:]}": x for k, x in self.feeds.items()}
            self.feeds |= {k: reduce(getitem, fields, goal) for k, fields in entry["inputs"]}
        try:
            return act()
        finally:
            self.obs, self.feeds, self.goal = before

    def made(self, entry: Any) -> Any:
        """Return the part of the policy that an entry of ``policy.json`` describes."""
        kinds = (_Code, _Network, _Model, _Part, _Hierarchy, _Function, _Automaton, _Plan)
        return next(k for k in kinds if k.__name__[1:] == entry["kind"])(self, entry)

    def asks(self, name: str, about: Any) -> bool:
        """Return the result of code on an observation or a step."""
        return bool(np.asarray(self.code[name](about))[0])

    def action(self, value: Any) -> Any:
        """Return an action that code gave, within the bounds of a Box.

        Raises:
            ValueError: it is none of the space.
        """
        space = self.space
        dtype = self.space.get("dtype", "int64")
        shape = space.get("shape", np.shape(space.get("nvec", 0)))
        if space["type"] == "MultiBinary":
            shape = space["n"]
            dtype = "int8"
        if space["type"] == "Box":
            value = np.reshape(value, shape)
            if not np.isfinite(value).all():
                raise ValueError(f"a policy returned the action {value}: NaN or an infinity")
            if np.dtype(dtype).kind in "iu" and value.dtype.kind == "f":
                value = np.rint(value)
            value = np.clip(value, *bounds(space, dtype))
            return np.asarray(value, dtype)[()]
        given = np.reshape(value, shape)
        action = np.nan_to_num(given).astype(dtype)
        if not (inside(action[None], space) and (action == given).all()):
            raise ValueError(f"a policy returned {given}, which is no action of {space}")
        return action[()]


def blank(entry: Any) -> Any:
    """Return a goal (1, ...) that stands where there is none."""
    goal = np.zeros((1, *entry["shape"]), np.dtype(entry["dtype"]))
    for part, value in zip(leaves(goal), entry["example"], strict=True):
        part[...] = value
    return goal


def leaves(goal: Any) -> list[Any]:
    """Return the parts of a goal (1, ...) that have no parts themselves."""
    names = goal.dtype.names
    return [goal] if names is None else [x for name in names for x in leaves(goal[name])]


def filled(goal: Any, value: Any) -> Any:
    """Return a goal (1, ...) after a value, or one for each of its parts, was written into it."""
    if (names := goal.dtype.names) is not None:
        by_place = isinstance(value, tuple | list)
        parts = dict(zip(names, value, strict=True)) if by_place else value
        for name in names:
            filled(goal[name], parts[name])
        return goal
    goal[...] = value = np.reshape(value, goal.shape)
    if goal.dtype.kind in "iub" and (goal != value).any():
        raise ValueError(f"the goal {value[0]} is not of {goal.dtype}")
    return goal


def inside(goal: Any, space: Any) -> bool:
    """Return whether a goal (1, ...) is in a space."""
    if (names := goal.dtype.names) is not None:
        parts = [x[1] if space["type"] == "Dict" else x for x in space["spaces"]]
        return all(inside(goal[name], part) for name, part in zip(names, parts, strict=True))
    if space["type"] == "Box":
        low, high = bounds(space, goal.dtype)
        finite = goal.dtype.kind != "f" or np.isfinite(goal).all()
        return bool(finite and (goal >= low).all() and (goal <= high).all())
    count = 2 if space["type"] == "MultiBinary" else np.array(space.get("nvec", space.get("n")))
    goal = goal - np.array(space.get("start", 0))
    return bool(((goal >= 0) & (goal < count)).all())


def bounds(space: Any, dtype: Any) -> list[Any]:
    """Return the lowest and the highest numbers of a Box: infinities are texts in JSON."""
    read = "f8" if np.dtype(dtype).kind == "f" else dtype
    both = (np.array(space[k], read).astype(dtype) for k in ("low", "high"))
    return [x.reshape(space["shape"]) if x.ndim else x for x in both]


def opened(path: Path) -> Any:
    """Return a session of an ONNX file, on one thread."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


class _Code:  # a skill that is a function of observations; and what all parts have
    why = RUNNING  # no call of it has ended

    def __init__(self, runner: Runner, entry: Any) -> None:
        self.runner, self.entry = runner, entry

    def reset(self) -> None: ...
    def observe(self, elapsed: int, timed_out: bool) -> None: ...
    def watch(self, last: Any, *when: Any) -> None: ...
    def may_start(self) -> Any:
        return np.ones(1, bool)

    def allowed(self, mask: Any, last: Any) -> Any:
        return mask[0]

    def act(self, mask: Any, last: Any = None) -> Any:
        return self.runner.action(self.result()[0])

    def result(self) -> Any:
        runner, how = self.runner, self.entry.get("with_goal")
        function = runner.code[self.entry["code"]]
        if how == "goal":
            return function(runner.obs, goal=runner.goal)
        return function(runner.obs, runner.goal) if how else function(runner.obs)


class _Network(_Code):  # a graph of observations, perhaps with a mask, a memory and noise
    def __init__(self, runner: Runner, entry: Any) -> None:
        super().__init__(runner, entry)
        self.session = opened(runner.path / entry["file"])
        self.reset()

    def reset(self) -> None:
        self.memory = {k: np.zeros((1, n), "f4") for k, n in self.entry["memory"].items()}

    def act(self, mask: Any, last: Any = None) -> Any:
        feeds = self.runner.feeds | self.memory
        if self.entry["choices"]:
            feeds["mask"] = np.ones((1, self.entry["choices"]), bool) if mask is None else mask
        for i, (kind, n) in enumerate(self.entry["noise"]):
            feeds[f"noise.{i}"] = getattr(self.runner.rng, kind)(size=(1, n)).astype(np.float32)
        action, *after = self.session.run(None, feeds)
        self.memory = dict(zip(self.memory, after, strict=True))
        return action[0]


class _Model(_Code):  # a model from elsewhere, or a function, behind a mapping
    def __init__(self, runner: Runner, entry: Any) -> None:
        super().__init__(runner, entry)
        self.session = opened(runner.path / entry["file"]) if entry["file"] else None
        given = self.session.get_inputs() if self.session else ()
        self.dtypes = {i.name: DTYPES[i.type[7:-1]] for i in given}
        self.reset()

    def reset(self) -> None:
        self.phase = 0
        self.last = np.zeros((1, self.entry["outputs"]))
        states = ((s, self.dtypes.get(s["input"], "f8")) for s in self.entry["state"])
        self.state = [np.zeros(s["shape"], dtype) for s, dtype in states]

    def act(self, mask: Any, last: Any = None) -> Any:
        if self.phase == 0:
            self.held = self.inferred(mask)
        action = self.held[self.phase // self.entry["every"]]
        self.phase = (self.phase + 1) % (self.entry["every"] * len(self.held))
        return action

    def inferred(self, mask: Any) -> list[Any]:
        """Return the actions of one inference, in their order."""
        sees = self.entry["sees"]
        chunk = self.entry["chunk"]
        given = self.runner.feeds if self.session else {"": self.runner.obs}
        if sees is not None:
            given = {name: self.seen(name, parts) for name, parts in sees.items()}
        output = self.called(given)
        outputs = [output] if chunk is None else [output[:, i] for i in range(chunk)]
        return [self.action(x, None if i else mask) for i, x in enumerate(outputs)]

    def called(self, given: Any) -> Any:
        """Return the output of the model, or of the function."""
        entry = self.entry
        if self.session:
            feeds = {k: np.asarray(v, self.dtypes[k]) for k, v in given.items()}
            feeds |= {s["input"]: x for s, x in zip(entry["state"], self.state, strict=True)}
            names = [entry["output"], *(s["output"] for s in entry["state"])]
            output, *self.state = self.session.run(names, feeds)
            return output
        function = self.runner.code[entry["code"]]
        single = entry["single_state"] or not self.state
        state: list[Any] = self.state if single else [tuple(self.state)]
        if entry["with_goal"]:
            value = self.result()
        elif "" in given:
            value = function(given[""], *state)
        else:
            value = function(**given, **({"state": state[0]} if state else {}))
        if state:
            value, after = value
            self.state = [after] if entry["single_state"] else list(after)
        return np.asarray(value)

    def seen(self, name: str, parts: Any) -> Any:
        """Return an input: its parts, joined and scaled."""
        x = np.concatenate([scaled(self.part(part), part) for part in parts], axis=1)
        x = scaled(x, self.entry["scaling"].get(name, {}))
        return x.reshape(1, *self.entry["shapes"][name])

    def part(self, part: Any) -> Any:
        """Return the numbers of a part of an input, (1, K)."""
        obs = self.runner.obs
        goal = self.entry["goal"]
        if part["source"] == "last_action":
            return self.last
        if part["source"] == "function":
            return np.reshape(self.runner.code[part["function"]](obs), (1, -1))
        if part["source"] == "goal":
            if self.runner.goal is not None:
                goal = np.concatenate([x.reshape(1, -1) for x in leaves(self.runner.goal)], axis=1)
            elif isinstance(goal, dict):
                goal = self.runner.code[goal["function"]](obs)
            low, high = (part.get(k) for k in ("low", "high"))
            goal = np.maximum(np.reshape(goal, (1, -1)), -np.inf if low is None else low)
            return np.minimum(goal, np.inf if high is None else high)
        x = np.reshape(reduce(getitem, part["fields"], obs), (1, -1))
        if part["choices"]:
            hot = [np.eye(n)[x[:, i] - start] for i, (n, start) in enumerate(part["choices"])]
            x = np.concatenate(hot, axis=1)
        places = part["places"]
        if isinstance(places, str):
            places = slice(*(int(i) if i else None for i in places.split(":")))
        return x if places is None else x[:, places]

    def action(self, x: Any, mask: Any) -> Any:
        """Return the action that an output (1, ...) means."""
        space = self.runner.space
        acts = self.entry["acts"] or {}
        to = acts.get("to")
        if space["type"] == "Box":
            x = np.reshape(x, (1, -1))
            x = np.clip(x, *acts["clip"]) if acts.get("clip") else x
            self.last = x = np.asarray(x, np.float64)
            x = x * np.array(acts.get("scale", 1.0)) + np.array(acts.get("offset", 0.0))
            if to is not None:
                size = int(np.prod(space["shape"]))
                full = np.zeros((1, size))
                others = np.setdiff1d(np.arange(size), to)
                full[:, others] = acts.get("rest", 0.0) if len(others) else 0.0
                full[:, to] = x
                x = full
            return self.runner.action(x)
        if x.dtype.kind == "f" and self.entry["logits"]:
            return self.runner.action(self.chosen(x, space, to, mask))
        return self.runner.action(x if to is None else np.array(to)[x] + space["start"])

    def chosen(self, x: Any, space: Any, to: Any, mask: Any) -> Any:
        """Return the best choices by logits (1, ...), or those that are drawn."""
        binary = space["type"] == "MultiBinary"
        rng = self.runner.rng
        if self.entry["sampled"]:
            x = x + (rng.logistic if binary else rng.gumbel)(size=x.shape)
        if binary:
            return x > 0
        if mask is not None:
            allowed = mask if to is None else mask[:, to]
            x = np.where(allowed, x, -np.inf) if allowed.shape == x.shape else x
        if to is not None:
            return to[int(x.argmax())] + space["start"]
        sizes = np.ravel(space["n"] if space["type"] == "Discrete" else space["nvec"])
        parts = np.split(x[0], np.cumsum(sizes)[:-1])
        best = np.reshape([part.argmax() for part in parts], np.shape(space["start"]))
        return best + space["start"]


class _Part(_Model):  # a policy that sees and writes a part, perhaps as a correction of another
    def __init__(self, runner: Runner, entry: Any) -> None:
        self.runner, self.entry = runner, entry
        self.policy = runner.made(entry["policy"])
        self.base = entry["base"] and runner.made(entry["base"])

    def reset(self) -> None:
        self.policy.reset()
        if self.base:
            self.base.reset()

    def act(self, mask: Any, last: Any = None) -> Any:
        entry, runner = self.entry, self.runner
        columns = entry["columns"]
        allowed = None if mask is None or columns is None else mask[:, columns]
        if allowed is not None and not allowed.any():
            raise ValueError("the mask allows none of the choices that the skill owns")
        before = runner.obs, runner.feeds, runner.space
        if entry["sees"] is not None:
            runner.obs, runner.feeds = self.own_view()
        try:
            runner.space = entry["action_space"]
            own = self.acted("policy", mask if columns is None else allowed)
            if self.base:
                runner.space = entry["part_space"]
                step = np.reshape(entry["step"], np.shape(own))
                own = runner.action(self.acted("base", None) + step * np.asarray(own, "f8"))
        finally:
            runner.obs, runner.feeds, runner.space = before
        return self.whole(own)

    def acted(self, which: str, mask: Any) -> Any:
        """Return what the policy does, or its base, which see the goal of the call in two ways."""
        policy, goal = getattr(self, which), self.runner.goal
        if goal is None:
            return policy.act(mask)
        entry = {"joined": self.entry["joined"][which], "inputs": self.entry["inputs"]}
        return self.runner.seeing(goal, entry, lambda: policy.act(mask))

    def own_view(self) -> Any:
        """Return the part of the observation as one array (1, ...), and as inputs of files."""
        obs = np.zeros((1, *self.entry["shape"]), np.dtype(self.entry["dtype"]))
        seen = {name: self.seen(name, parts) for name, parts in self.entry["sees"].items()}
        if "" in seen:
            obs[...] = seen[""]
            return obs, {"obs": obs}
        for name, value in seen.items():
            obs[name] = value
        return obs, {f"obs.{name}": obs[name] for name in seen}

    def whole(self, own: Any) -> Any:
        """Return the environment's action for the skill's own one."""
        entry, space = self.entry, self.runner.space
        if entry["to"] is None:
            return self.runner.action(own)
        if entry["fixed"] is None:
            return self.runner.action(np.array(entry["to"])[own] + space["start"])
        full = np.array(entry["fixed"], "f8")
        if latest := self.runner.before:
            held = np.array(entry["held"], bool)
            full[held] = np.ravel(latest["action"][0])[held]
        full[entry["to"]] = np.ravel(own)
        return self.runner.action(full)


def scaled(x: Any, by: Any) -> Any:
    """Return numbers (1, K) less an offset, times a scale, and clipped."""
    x = (x - np.array(by.get("offset", 0.0))) * np.array(by.get("scale", 1.0))
    return np.clip(x, *by["clip"]) if by.get("clip") else x


class _Hierarchy(_Code):  # a selector and its skills; it decides where a call ends
    def __init__(self, runner: Runner, entry: Any) -> None:
        super().__init__(runner, entry)
        self.selector = runner.made(entry["selector"])
        self.skills = entry["skills"]
        self.guide = runner.made(entry["guide"] or {"kind": "Code"})  # or nothing: all is allowed
        self.policies = [runner.made(skill["policy"]) for skill in self.skills]
        self.critic = entry["critic"] and runner.made(entry["critic"])
        self.own: Any = None  # the entry of its goals, as a skill that has some
        self.given: Any = None  # the goal of its call
        for skill, policy in zip(self.skills, self.policies, strict=True):
            if skill["goal"] and isinstance(policy, _Hierarchy):
                policy.own = skill["goal"] | {"joined": True}

    def reset(self) -> None:
        self.skill, self.why, self.succeeded, self.goal = -1, EPISODE, False, None
        self.selector.reset()
        self.guide.reset()

    def may_start(self) -> Any:
        asks = self.runner.asks
        obs = self.runner.obs
        code = [s["initiation"] for s in self.skills]
        may = [name is None or asks(name, obs) for name in code]
        return may & np.array([policy.may_start().any() for policy in self.policies])

    def act(self, mask: Any, last: Any = None) -> Any:
        lengths, runner = self.entry["lengths"] or [np.inf], self.runner
        if self.why != RUNNING:
            self.given, may = runner.goal, self.may_start()
            before = getattr(self.selector, "memory", None)
            for _ in range(TRIES):
                self.selector.memory = before
                choice, goals = self.as_selector(lambda: self.decided(may, len(lengths)))
                skill, length = divmod(int(choice), len(lengths))
                self.goal = self.fitted(self.skills[skill], goals.get(skill))
                if not self.holds(self.skills[skill]["termination"]):
                    break
            part = self.policies[skill]
            if skill != self.skill or (self.goal is not None and isinstance(part, _Hierarchy)):
                part.reset()
            self.limit = min(lengths[length], self.skills[skill]["limit"] or np.inf)
            self.skill, self.elapsed, self.why = skill, 0, RUNNING
        action = self.with_goal(lambda: self.policies[self.skill].act(mask))
        for condition, code, fixed in self.entry["reflexes"]:
            if runner.asks(condition, runner.obs):
                action = runner.action(fixed if code is None else runner.code[code](runner.obs)[0])
        return action

    def holds(self, termination: Any) -> bool:
        """Return whether its goal ends the call at no step: a selector that samples goes on."""
        if self.goal is None or not termination or not self.selector.entry.get("noise"):
            return False
        runner, no = self.runner, np.zeros(1, "f4")
        still = {"obs": runner.obs, "next_obs": runner.obs, "action": no, "reward": no, "info": {}}
        runner.latest = still
        with suppress(Exception):
            return runner.asks(termination, runner.step(1, False, self.goal))
        return False

    def with_goal(self, act: Any) -> Any:
        """Return what the running skill does, where it sees its goal."""
        if self.goal is None and self.own is None:
            return act()
        entry = self.skills[self.skill]["goal"] or {"joined": False}
        return self.runner.seeing(self.goal, entry, act)

    def as_selector(self, act: Any) -> Any:
        """Return what the selector, the guide or the critic does, which see the own goal."""
        return self.runner.seeing(self.given, self.own, act) if self.own else act()

    def decided(self, may: Any, lengths: int) -> Any:
        """Return the number of the next choice, and goals by the places of skills."""
        may = self.guide.allowed(may[None], self)
        may = may.repeat(lengths * len(self.skills) // len(may))  # a plan has chosen the length
        if not may.any():
            raise ValueError(f"no skill may start in observation {self.runner.obs[0]}")
        choice, goals = self.parted(self.selector.act(may[None], self))
        free = np.flatnonzero(may).tolist()
        if choice not in free:
            names = dict.fromkeys(self.skills[i // lengths]["name"] for i in free)
            raise ValueError(f"the selector chose {choice}; it may choose {', '.join(names)}")
        return choice, goals

    def worth(self) -> Any:
        """Return the values of skills and of a new decision; a critic sees the call's goal."""
        runner, goals = self.runner, [(i, s["goal"]) for i, s in enumerate(self.skills)]
        before = runner.feeds
        if any(entry for _, entry in goals):
            runner.feeds = {f"obs.observation{k[3:]}": x for k, x in before.items()}
        for i, entry in goals:
            if entry:
                goal: Any = self.goal if i == self.skill else blank(entry)
                for k, fields in entry["inputs"]:
                    name = f"obs.goal.{self.skills[i]['name']}{k[8:]}"
                    runner.feeds[name] = reduce(getitem, fields, goal)
        try:
            return self.critic.act(None)
        finally:
            runner.feeds = before

    def parted(self, choice: Any) -> Any:
        """Return the number of a choice, and goals by the places of skills."""
        if isinstance(choice, tuple):
            return choice
        goals, row = {}, np.ravel(choice)  # of a network: the number, then the goals of all skills
        at = 1
        for i, skill in enumerate(self.skills if len(row) > 1 else ()):
            if skill["goal"]:
                goals[i] = blank(skill["goal"])
                for part in leaves(goals[i]):
                    part[...] = row[at : at + part.size].reshape(part.shape)
                    at += part.size
        return row[0], goals

    def fitted(self, skill: Any, value: Any) -> Any:
        """Return the goal (1, ...) of a call of a skill; None: it has no goals."""
        if not (entry := skill["goal"]):
            return None
        if value is None:
            raise ValueError(f"skill {skill['name']!r} has goals, but the selector gave none")
        try:
            goal = filled(blank(entry), value)
            if entry["clip"]:
                value = self.runner.code[entry["clip"]](self.runner.obs, goal)
                goal = filled(blank(entry), value)
        except (KeyError, TypeError, ValueError) as error:
            whose = f"skill {skill['name']!r} has goals of {entry['space']}, but was given"
            raise ValueError(f"{whose} {value!r}: {error}") from error
        if not inside(goal, entry["space"]):
            raise ValueError(f"the goal {goal[0]} of skill {skill['name']!r} is out of its space")
        return goal

    def observe(self, elapsed: int, timed_out: bool) -> None:
        runner = self.runner
        entry = self.skills[self.skill]
        self.elapsed = self.elapsed + 1
        when: Any = (self.elapsed, self.elapsed >= (entry["max_steps"] or np.inf), self.goal)
        (below := self.policies[self.skill]).observe(*when[:2])
        stuck = below.why != RUNNING and not below.may_start().any()
        self.why = LIMIT if stuck or self.elapsed >= self.limit else RUNNING
        if entry["termination"] and runner.asks(entry["termination"], runner.step(*when)):
            self.why = OWN
        if self.critic and self.why == RUNNING:
            worth = self.as_selector(self.worth)
            may = self.may_start()
            margin = self.entry["margin"]
            gain = worth[len(may) :] - worth[self.skill]
            self.why = INTERRUPTED if may.any() and any(gain > margin) else RUNNING
        judge, self.succeeded = entry["success"], self.why == OWN
        if judge and self.why != RUNNING:
            self.succeeded = runner.asks(judge, runner.step(*when))
        self.selector.watch(self, elapsed, timed_out, self.given)
        self.guide.watch(self, elapsed, timed_out, self.given)


class _Function(_Code):  # a selector: observations, perhaps how the last call ended, to a skill
    def act(self, mask: Any, last: Any = None) -> Any:
        has_goals = self.entry["goals"]
        ended = {k: np.array([getattr(last, k)]) for k in ("skill", "why", "succeeded")}
        more = [SimpleNamespace(**ended)] * self.entry["asks_last"]
        chosen = self.runner.code[self.entry["code"]](self.runner.obs, *more)
        chosen, goals = chosen if isinstance(chosen, tuple) and has_goals else (chosen, {})
        names, chosen = self.entry["names"], np.asarray(chosen)[0]
        by_skill = isinstance(goals, dict) and (not goals or set(goals) & set(names))
        if len(has_goals) == 1 and not by_skill:
            goals = {has_goals[0]: goals}
        elif not by_skill or not set(goals) <= set(has_goals):
            raise ValueError(f"the selector gave the goals {goals!r}: give {{skill: goals}}, "
                             f"of skills with goals: {', '.join(has_goals)}")  # fmt: skip
        number = names.index(chosen) if isinstance(chosen, str) and chosen in names else chosen
        return number, {names.index(name): goal for name, goal in goals.items()}

    def allowed(self, mask: Any, last: Any) -> Any:
        return mask[0] & (np.arange(mask.shape[1]) == self.act(mask, last)[0])


class _Automaton(_Code):  # a selector: skills of each state, best first; transitions by events
    def reset(self) -> None:
        self.state = self.entry["start"]

    def act(self, mask: Any, last: Any = None) -> Any:
        skills = self.entry["skills"][self.state]
        chosen = next((skill for skill in skills if mask[0, skill]), None)
        code, obs = self.runner.code, self.runner.obs
        goals = {skill: fixed if name is None else code[name](obs)
                 for state, skill, fixed, name in self.entry["goals"]
                 if (state, skill) == (self.state, chosen)}  # fmt: skip
        return chosen, goals

    def allowed(self, mask: Any, last: Any) -> Any:
        return mask[0] & np.isin(np.arange(mask.shape[1]), self.entry["skills"][self.state])

    def watch(self, last: Any, *when: Any) -> None:
        asks, step = self.runner.asks, self.runner.step
        ended = {"success": last.succeeded, "failure": not last.succeeded}
        for origin, target, event, code in self.entry["transitions"]:
            over = last.why != RUNNING and ended.get(event)
            if self.state == origin and (asks(code, step(*when)) if code else over):
                self.state = target
                return


class _Plan(_Function):  # a selector: the option whose nearest logged calls are worth most
    def __init__(self, runner: Runner, entry: Any) -> None:
        super().__init__(runner, entry)
        with np.load(runner.path / entry["file"]) as data:
            self.data = dict(data)
        self.skill_of, self.lengths = self.data["skill_of"], self.data["lengths"]
        choices, options = np.transpose(entry["groups"])
        self.choice_of = choices.repeat(options)
        self.group_of = np.arange(len(options)).repeat(options)
        self.reset()

    def reset(self) -> None:
        self.state = self.data["machine.start"]
        self.calls: list[Any] = []  # the latest of the episode, which count beside the logged ones

    def act(self, mask: Any, last: Any = None) -> Any:
        entry, features = self.entry, self.features()
        here, (places, share) = self.near(features), self.corners()
        q = ((self.data["worth"][here.pieces][..., places] * share).sum(2) * here.weights).sum(1)
        known = np.isfinite(here.far)
        far = np.where(known, here.far, 0.0) / self.data["units"]
        q = np.where(q > 0, q / (1 + entry["caution"] * far), q)
        here.q = np.where(known, q, -np.inf).astype("f4")
        here.may = np.ones(len(q), bool) if mask is None else mask[0][self.choice_of]
        here.to = places[share.argmax()]
        if self.calls:
            self.calls[-1] = SimpleNamespace(**{**vars(self.calls[-1]), **vars(here)})
        q = self.corrected(here)
        score = np.where(here.may, np.maximum(q, -1e30), -np.inf)
        if entry["temperature"]:
            largest = np.abs(np.where(here.may & np.isfinite(q), q, 0.0)).max()
            score = score / (entry["temperature"] * max(largest, 1e-12))
            score = score + self.runner.rng.gumbel(size=len(q))
        option = score.argmax()
        choice, place = self.choice_of[option], here.places[option]
        call = SimpleNamespace(choice=choice, start=features, origin=here.to)
        call.aim, goals = here.aims[option], {}
        if place >= 0 and entry["goals"]:
            goals[self.skill_of[choice]] = self.data[f"goals.{self.group_of[option]}"][place]
        elif place >= 0:
            call.aim = call.aim + np.nan  # a guide does not say which goal: unknown
        call.steps, call.reward, call.discount = 0, 0.0, 1.0
        self.calls = [*self.calls, call][-entry["latest"] :]
        return choice, goals

    def allowed(self, mask: Any, last: Any) -> Any:
        return super().allowed(mask.repeat(max(1, len(self.lengths)), axis=1), last)

    def watch(self, last: Any, *when: Any) -> None:
        step, asks = self.runner.step(*when), self.runner.asks
        events = [asks(code, getattr(step, {"obs": "next_obs"}.get(reads, reads), step))
                  for code, reads in self.entry["events"]]  # fmt: skip
        code = (self.runner.code[name] for name in self.entry["rewards"])
        values = [0.0, *(float(np.asarray(function(step))[0]) for function in code)]
        reward = self.advance([*events, False, True], values)
        call = self.calls[-1]
        call.steps += 1
        call.reward += call.discount * reward
        call.discount *= self.entry["gamma"]
        if len(self.lengths) and last.why == LIMIT:
            at = min(np.searchsorted(self.lengths, call.steps), len(self.lengths) - 1)
            call.choice = last.skill * len(self.lengths) + int(at)

    def advance(self, events: Any, values: Any) -> float:
        """Move the task's state by what has happened in a step; return the reward."""
        machine = {k[8:]: v for k, v in self.data.items() if k.startswith("machine.")}
        q, counts = self.state[0], self.state[1:]
        goes_on = np.array(events)[machine["counted"][q]]
        counts = np.where(goes_on, counts + 1, 0)
        true = [*events, *(counts >= machine["counter_steps"][q])]
        reward = machine["each"][q] + values[machine["each_by"][q]]
        after = q
        for t, atoms in enumerate(machine["atoms"][q]):
            if all(true[atom] for atom in atoms):
                after = machine["target"][q, t]
                reward += machine["paid"][q, t] + values[machine["paid_by"][q, t]]
                counts = np.where(machine["keeps"][q, t], counts, 0)
                break
        self.state = np.array([after, *counts])
        return float(reward)

    def features(self) -> list[Any]:
        """Return what each skill's calls are compared by, (F,) each."""
        each, obs, kinds = [], self.runner.obs, ("mean", "scale", "varies", "places")
        for i, code in enumerate(self.entry["features"]):
            part: Any = {k: self.data.get(f"{k}.{i}") for k in kinds}
            raw: Any = self.runner.code[code](obs) if code else np.reshape(obs, (1, -1))
            raw = raw if code else raw.astype("f4")[:, part["places"]]
            raw = np.asarray(raw, "f8").ravel()
            standard = ((raw - part["mean"]) * part["scale"])[part["varies"]]
            each.append(np.asarray(standard.clip(-self.entry["far"], self.entry["far"]), "f4"))
        return each

    def near(self, features: list[Any]) -> Any:
        """Return what the log says of each option where the skills' calls start at features."""
        skills = self.skill_of[[choice for choice, _ in self.entry["groups"]]]
        found = [self.option(g, features[skill]) for g, skill in enumerate(skills)]
        pieces, far, aims, places = (np.concatenate(part) for part in zip(*found, strict=True))
        weights = 1.0 / (np.where(np.isfinite(far), far, 1e9) + self.entry["soft"])
        total = weights.sum(1)
        return SimpleNamespace(
            pieces=pieces, weights=weights / total[:, None], far=far[:, 0], total=total,
            aims=aims, places=places, end=features,
        )  # fmt: skip

    def option(self, group: int, to: Any) -> tuple[Any, ...]:
        """Return the nearest pieces of a group's options (O, K) to features, distances, and goals.

        Goals are standardised (O, G), and places (O,) in the group's goals; -1: there is none.
        """
        entry, data, k = self.entry, self.data, self.entry["neighbours"]
        rows, starts = data[f"rows.{group}"], data[f"starts.{group}"]
        options = entry["groups"][group][1]
        many = k if options == 1 else options
        distance = np.sqrt(((starts - to) ** 2).sum(1))
        call = data["call"][rows]
        order = np.argsort(distance, kind="stable")[: many * entry["ahead"]]
        _, first = np.unique(call[order], return_index=True)  # the nearest of each call
        found = order[np.sort(first)[:many]]
        # Of an option count the calls that are nearest by start and goal.
        aims = data.get(f"aims.{group}", np.zeros((len(rows), entry["aims"]), "f4"))[found]
        off = np.square(aims[:options, None] - aims).sum(2)
        both = np.sqrt(distance[found] ** 2 + off)
        least = np.argsort(both, axis=1, kind="stable")[:, :k]
        n, m = least.shape
        pieces, far = np.zeros((options, k), int), np.full((options, k), np.inf, "f4")
        pieces[:n, :m], far[:n, :m] = rows[found[least]], np.take_along_axis(both, least, 1)
        limit = np.float32(entry["further"]) * np.maximum(far[:, :1], data["usual"][group])
        own, places = np.zeros((options, entry["aims"]), "f4"), np.full(options, -1)
        own[:n] = aims[:options]
        places[:n] = found[:options] if f"aims.{group}" in data else -1
        return pieces, np.where(far <= limit, far, np.float32(np.inf)), own, places

    def corners(self) -> Any:
        """Return the planning states around the task's state, and their shares."""
        data, q = self.data, self.state[0]
        levels, spacing = data["states.levels"][q], data["states.spacing"][q]
        level = self.state[1:] / spacing
        low = np.clip(np.floor(level), 0, np.maximum(levels - 2, 0)).astype(int)
        up = np.where(levels > 1, np.clip(level - low, 0.0, 1.0), 0.0)
        places, shares = [], []
        for upper in np.ndindex(*[2] * len(levels)):
            place, share = 0, 1.0
            for slot, higher in enumerate(upper):
                place = place * levels[slot] + min(low[slot] + higher, levels[slot] - 1)
                share *= up[slot] if higher else 1.0 - up[slot]
            places.append(data["states.first"][q] + place)
            shares.append(share)
        return np.array(places), np.array(shares, "f4")

    def corrected(self, here: Any) -> Any:
        """Return the values of the options where the calls of the episode count as logged ones."""
        entry, calls = self.entry, self.calls
        if not calls:
            return here.q
        ends = [*calls, here]
        choice = np.array([call.choice for call in calls])
        skill = self.skill_of[choice]
        far = np.sqrt([[np.square(e.end[s] - c.start[s]).sum() + np.square(e.aims - c.aim).sum(1)
                        for c, s in zip(calls, skill, strict=True)] for e in ends])  # fmt: skip
        same = np.array([[e.to == c.origin for c in calls] for e in ends])[..., None]
        same = same & (choice[:, None] == self.choice_of)
        same &= far <= np.array([e.far for e in ends])[:, None] + entry["slack"]
        if not same[-1].any():
            return here.q
        weight = np.where(same, entry["trust"] / (far + entry["soft"]), 0.0)
        own, logged = weight.sum(1), np.array([e.q for e in ends])
        known, may = np.isfinite(logged), np.array([e.may for e in ends])
        total = np.where(known, np.array([e.total for e in ends]), 0.0)
        base = np.where(known, logged, 0.0) * total
        both = np.where(known | (own > 0), np.maximum(total + own, 1e-12), np.inf)
        paid = np.array([[c.reward, c.discount] for c in calls])

        def best(q: Any) -> Any:
            best = np.where(may[:-1], q[:-1], -np.inf).max(1)
            return np.where(np.isfinite(best), best, 0.0)

        value, q = best(np.where(own > 0, -np.inf, logged)), logged
        for _ in range(entry["latest"]):
            y = paid[:, 0] + paid[:, 1] * value
            q = (base + np.einsum("eco,c->eo", weight, y)) / both
            q = np.where(~known & (own <= 0), -np.inf, q)
            value = best(q)
        return q[-1].astype("f4")
