"""Environments in processes of their own, whose errors and deaths are told as sentences.

What goes between the processes is text and arrays: an error is told, not pickled. Whoever waits for
an answer also watches whether those who owe it are alive.
"""

from __future__ import annotations

import multiprocessing as mp
import os
import signal
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import deepcopy
from multiprocessing.connection import Connection, wait
from time import monotonic
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import (
    CloudpickleWrapper,
    batch_space,
    concatenate,
    create_empty_array,
)

from skillweave.messages import told
from skillweave.types import SkillweaveError

PATIENCE = 1.0
"""Seconds that workers have to end by themselves when they are closed."""
LOOK = 1.0
"""Seconds between looks of a waiting worker at whether its parent lives."""


class WorkerVector(VectorEnv[Any, Any, Any]):
    """As Gymnasium's AsyncVectorEnv with autoreset disabled, for ``GymnasiumEngine``.

    ``step`` takes (go, action) as ``Pausable`` does: who does not go is not asked. After an error
    nothing but ``close`` works; that needs two seconds at most, whatever the environments do.

    Args:
        makers: functions that make the environments.
        name: what messages call the environment.

    Raises:
        SkillweaveError: an environment failed or its process died; the message names which.
    """

    def __init__(self, makers: Sequence[Callable[[], gym.Env[Any, Any]]], name: str) -> None:
        self.num_envs, self._name = len(makers), name
        self._pipes: list[Connection] = []
        self._workers: list[Any] = []
        self._steps = np.zeros(self.num_envs, np.int64)
        context = mp.get_context()
        try:
            for i, make in enumerate(makers):
                ours, theirs = context.Pipe()
                work = (i, CloudpickleWrapper(make), theirs, ours, os.getpid())
                worker = context.Process(target=_work, args=work, name=f"env-{i}", daemon=True)
                self._pipes.append(ours)
                self._workers.append(worker)
                worker.start()
                theirs.close()
            spaces = self._answers(range(self.num_envs))
        except BaseException:
            self.close_extras()
            raise
        self.single_observation_space, self.single_action_space = spaces[0]
        for i, found in spaces.items():
            if found != spaces[0]:
                self.close_extras()
                raise SkillweaveError(
                    f"{name}: environment {i} has other spaces than environment 0: "
                    f"{found} and {spaces[0]}"
                )
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._batch: Any = create_empty_array(
            self.single_observation_space, self.num_envs, np.zeros
        )
        self._obs: list[Any] = [None] * self.num_envs

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start anew all, or those of ``options["reset_mask"]``; ``seed``: one for each."""
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, bool))
        seeds = seed if isinstance(seed, list) else [seed] * self.num_envs
        info: dict[str, Any] = {}
        for i, (obs, own) in self._ask("reset", {int(i): seeds[i] for i in np.flatnonzero(mask)}):
            self._obs[i], self._steps[i] = obs, 0
            info = self._add_info(info, own, i)
        return self._together(), info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step those that go; the others stand still."""
        go, action = actions
        n = self.num_envs
        reward, terminated, truncated = np.zeros(n), np.zeros(n, bool), np.zeros(n, bool)
        info: dict[str, Any] = {}
        self._steps += go
        tasks = {int(i): (1, action[i]) for i in np.flatnonzero(go)}
        for i, (obs, *rest, own) in self._ask("step", tasks):
            self._obs[i] = obs
            reward[i], terminated[i], truncated[i] = rest
            info = self._add_info(info, own, i)
        return self._together(), reward, terminated, truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        """Let the workers close their environments; end those that do not."""
        for pipe in self._pipes:
            with suppress(OSError):
                pipe.send(("close", None))
        until = monotonic() + PATIENCE
        for end in ("join", "terminate", "kill"):
            for worker in self._workers:
                if end != "join" and worker.is_alive():
                    getattr(worker, end)()
            for worker in self._workers:
                if worker.pid is not None:
                    worker.join(max(0.0, until - monotonic()))
            until = monotonic() + PATIENCE / 2
        for pipe in self._pipes:
            pipe.close()

    def _ask(self, what: str, tasks: dict[int, Any]) -> list[tuple[int, Any]]:
        """Send each worker its task; their answers, in the order of their numbers."""
        for i, task in tasks.items():
            try:
                self._pipes[i].send((what, task))
            except OSError:
                raise self._died(i) from None
        return sorted(self._answers(tasks).items())

    def _answers(self, numbers: Any) -> dict[int, Any]:
        """The next answer of each of these workers."""
        due = {self._pipes[i]: i for i in numbers}
        found: dict[int, Any] = {}
        while due:
            # A pipe whose other end is gone is ready too; another worker may still hold that end.
            lives = {self._workers[i].sentinel: pipe for pipe, i in due.items()}
            for ready in wait([*due, *lives]):
                pipe = ready if isinstance(ready, Connection) else lives[ready]
                if pipe not in due:
                    continue
                i = due.pop(pipe)
                try:
                    if not pipe.poll():
                        raise EOFError
                    error, found[i] = pipe.recv()
                except (EOFError, OSError):
                    raise self._died(i) from None
                if error is not None:
                    raise SkillweaveError(error)
        return found

    def _died(self, i: int) -> SkillweaveError:
        worker = self._workers[i]
        worker.join(PATIENCE)
        code = worker.exitcode
        how = f"with exit code {code}"
        if code is not None and code < 0:
            how = f"by signal {-code} ({signal.strsignal(-code)})"
            how += ", perhaps because memory ran out" if -code == signal.SIGKILL else ""
        return SkillweaveError(
            f"{self._name}: the process of environment {i} died {how} at step {self._steps[i]} of "
            "its episode"
        )

    def _together(self) -> Any:
        space = self.single_observation_space
        return deepcopy(concatenate(space, self._obs, self._batch))


def _work(number: int, make: Any, pipe: Connection, other_end: Connection, parent: int) -> None:
    """The life of a worker: answer (error, result) to every (what, task)."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, who then closes us
    other_end.close()
    try:
        env = make.fn()
        pipe.send((None, (env.observation_space, env.action_space)))
        while True:
            while not pipe.poll(LOOK):
                if os.getppid() != parent:
                    return
            what, task = pipe.recv()
            if what == "close":
                env.close()
                return
            pipe.send((None, env.reset(seed=task) if what == "reset" else env.step(task)))
    except (EOFError, BrokenPipeError):
        return  # nobody is left to be told
    except SkillweaveError as error:
        pipe.send((str(error), None))
    except BaseException as error:
        pipe.send((f"environment {number}: {told(error)}", None))
