"""Videos of a policy at work: who acts is written under every frame."""

from __future__ import annotations

import functools
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from skillweave.envs.checks import LONGEST_FILM
from skillweave.envs.engine import GymnasiumEngine
from skillweave.envs.make import EnvSpec
from skillweave.messages import whole_number
from skillweave.reporting.captions import caption
from skillweave.reporting.palette import BLACK, PALETTE, RGB, color_of
from skillweave.reporting.video_file import VideoWriter, extra
from skillweave.seeding import Seeds
from skillweave.types import Array, Memory, Policy, SkillweaveError, Step

__all__ = ["PALETTE", "VideoWriter", "caption", "color_of", "render_policy"]

MAX_WIDTH = 960  # pixels; larger frames are reduced
HOLD = 1.0  # seconds that the last frame of an episode stands


def render_policy(
    env_spec: EnvSpec,
    policy: Policy,
    path: str | Path,
    *,
    episodes: int = 1,
    seed: int = 0,
    deterministic: bool = True,
    max_steps: int | None = None,
    label: Callable[[Memory], tuple[str, RGB]] | None = None,
    fps: float | None = None,
    every: int = 2,
    rng: np.random.Generator | None = None,
) -> dict[str, Any]:
    """Run a policy on Gymnasium's environment and write a captioned video of it.

    Args:
        seed: episode i starts from ``reset(seed=seed + i)``.
        max_steps: of an episode; None: the environment's own limit, at most ``LONGEST_FILM``.
        label: from the policy's memory after ``act`` to who acted, and its colour.
        fps: steps shown per second; None: as many as the environment says, so in real time.
        every: one frame for so many steps, and one for the end of each episode.
        rng: for ``act``; None: derived from ``seed``.

    Returns:
        ``path``, ``frames``, and ``episodes``: for each its ``return``, its ``length``, whether it
        was ``cut`` before its end and, as ``skills``, how many steps each acted.

    Raises:
        SkillweaveError: the environment gives no frames; see VideoWriter for more.
        MissingExtra: the extra 'video' is not installed.
    """
    episodes, every = whole_number(episodes, "episodes", 1), whole_number(every, "every", 1)
    seed = whole_number(seed, "seed", 0)
    limit = LONGEST_FILM if max_steps is None else whole_number(max_steps, "max_steps", 1)
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # else pygame looks for a screen
    act = functools.partial(
        policy.act, deterministic=deterministic, rng=rng or (Seeds(seed) / "render").numpy()
    )
    env, told = env_spec.make(render_mode="rgb_array"), []
    # Observations, infos and masks are those of an evaluation.
    engine = GymnasiumEngine(lambda number: env, 1, env_spec.name)
    try:
        with VideoWriter(path, (fps or env.metadata.get("render_fps") or 30) / every) as video:
            for i in range(episodes):
                who, color, skills = "", BLACK, Counter[str]()
                for now in _play(engine, policy, act, seed + i, limit):
                    if label is not None and not now.over:
                        who, color = label(now.memory)
                        skills[who] += 1
                    if now.over or now.elapsed % every == 0:
                        word = "final return" if now.over else "return"
                        text = f"step {now.elapsed}   {word} {now.total:+.1f}"
                        frame = caption(_frame(env), who, color, text)
                        video.add(frame, HOLD if now.over else None)
                told.append(now.told(skills))
    finally:
        engine.close()
    return {"path": str(path), "frames": video.frames, "episodes": told}


class _Moment(NamedTuple):
    memory: Memory  # after acting, where the episode is not over
    elapsed: int  # steps
    total: float  # the return so far
    over: bool
    ended: bool = False  # the environment ended it

    def told(self, skills: Counter[str]) -> dict[str, Any]:
        """The episode, at its end."""
        how = {"return": self.total, "length": self.elapsed, "cut": not self.ended}
        return how | {"skills": dict(skills)}


def _play(
    engine: GymnasiumEngine, policy: Policy, act: Callable[..., Any], seed: int, limit: int
) -> Iterator[_Moment]:
    """An episode: a moment before each step, when the action is chosen, and one at the end."""
    obs = engine.reset_some(np.zeros(1, np.int64), [seed])
    memory, total, elapsed, over = policy.start(1), 0.0, 0, False
    while not over and elapsed < limit:
        action, memory = act(memory, obs, engine.mask())
        yield _Moment(memory, elapsed, total, False)
        raw = engine.step(action)
        elapsed, total = elapsed + 1, total + float(raw.reward[0])
        over = bool(raw.terminated[0] | raw.truncated[0])
        step = Step(
            obs, action, raw.next_obs, raw.reward, raw.terminated, raw.truncated,
            np.zeros(1, bool), np.array([elapsed]), raw.info,
        )  # fmt: skip
        obs, memory = raw.next_obs, policy.observe(memory, step)
    yield _Moment(memory, elapsed, total, True, over)


def _frame(env: gym.Env[Any, Any]) -> Array:
    """What the environment shows now, reduced to at most ``MAX_WIDTH``."""
    frame: Any = env.render()
    if not isinstance(frame, np.ndarray):
        raise SkillweaveError(f"{env} cannot be filmed: render() gave {type(frame).__name__}")
    factor = -(-frame.shape[1] // MAX_WIDTH)
    return frame if factor == 1 else np.asarray(extra("PIL.Image").fromarray(frame).reduce(factor))
