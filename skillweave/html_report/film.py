"""The film of a report: steps of episodes that were written down are played again, and drawn."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave.envs.engine import GymnasiumEngine, RawStep
from skillweave.envs.make import EnvSpec
from skillweave.errors import EnvError
from skillweave.policies.core import Array
from skillweave.reporting.progress import EpisodeProgress
from skillweave.reporting.screen import without_screen
from skillweave.reporting.video import enlarged, frame_of
from skillweave.reporting.video_file import VideoWriter
from skillweave.training.played_calls import Episode

MOST_FRAMES = 1_500
MOST_BYTES = 2_800_000  # as text in the page a third more
HOLD = 12  # frames for which the end of a shot stays
USUAL_FPS = 30


@dataclass(frozen=True)
class Mp4:
    """An MP4 of several shots, one after another."""

    data: bytes
    fps: float
    """Frames per second."""
    every: int
    """Steps per frame."""
    first: dict[int, int]
    """By a shot's key, its first frame; it shows the start."""


@dataclass(frozen=True)
class Shot:
    """Steps of an episode to be played again and filmed, from its seed, with the same actions."""

    seed: int
    actions: Array
    """From the start of the episode to the end of the shot, (T, *action_shape)."""
    same: Callable[[int, Array, RawStep | None], bool]
    """Return whether the environment repeats itself: after step t, with its next observation and
    the step; 0 and None: after the reset."""
    origin: str
    """The seed in words, for an error."""
    first: int = 0
    """Steps of the episode before the shot."""


def episode_shot(episode: Episode) -> Shot:
    """Return the shot of a whole episode, which has the same rewards and no earlier end."""

    def same(t: int, obs: Array, step: RawStep | None) -> bool:
        """Return whether a step of the film's episode is as it was written down."""
        if step is None:
            return True
        over = bool(step.terminated[0] | step.truncated[0])
        early = over and t < len(episode.actions)
        return not early and float(step.reward[0]) == episode.rewards[t - 1]

    return Shot(episode.seed, episode.actions, same, f"seed {episode.seed}")


@without_screen()
def make_film(
    spec: EnvSpec,
    shots: Mapping[int, Shot],
    most_frames: int = MOST_FRAMES,
    most_bytes: int = MOST_BYTES,
    check_spaces: Callable[[gym.Space[Any], gym.Space[Any]], None] | None = None,
    *,
    quiet: bool = True,
) -> Mp4:
    """Play shots again, one after another, and film them.

    Args:
        shots: by any key.
        most_frames: of the steps; the end of each shot has further ones.
        most_bytes: of the film, about.
        check_spaces: raise where observations or actions of the environment are of other spaces.
        quiet: no progress.

    Raises:
        EnvError: the environment gives no frames, or does not repeat itself.
        MissingExtra: the extra 'video' is not installed.
    """
    lengths = [len(shot.actions) - shot.first for shot in shots.values()]
    every = max(2, -(-sum(lengths) // most_frames))
    frames = sum(n // every + HOLD + 1 for n in lengths)
    env = spec.make(render_mode="rgb_array")
    engine = GymnasiumEngine(lambda number: env, 1, spec.name)
    fps = (env.metadata.get("render_fps") or USUAL_FPS) / 2
    first: dict[int, int] = {}
    try:
        if check_spaces is not None:
            check_spaces(engine.observation_space, engine.action_space)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "film.mp4"
            progress = EpisodeProgress(len(shots), quiet=quiet, name="film")
            with VideoWriter(path, fps, int(8 * most_bytes * fps / frames)) as video, progress:
                for key, shot in shots.items():
                    first[key] = video.frames
                    _play(shot, env, engine, video, every, progress)
            return Mp4(path.read_bytes(), fps, every, first)
    finally:
        engine.close()


def _play(
    shot: Shot,
    env: gym.Env[Any, Any],
    engine: GymnasiumEngine,
    video: VideoWriter,
    every: int,
    progress: EpisodeProgress,
) -> None:
    """Play the actions of an episode again, and film every so many steps."""
    row = np.arange(1)
    step = None
    obs = engine.reset_some(row, [shot.seed])
    for t in range(len(shot.actions) + 1):
        if not shot.same(t, obs[0], step):
            raise EnvError(
                f"from {shot.origin} and with the same actions, the environment did another thing "
                f"in step {t}: it does not repeat itself"
            )
        if t == len(shot.actions):
            break
        if t >= shot.first and (t - shot.first) % every == 0:
            video.add(enlarged(frame_of(env)))
        step = engine.step(shot.actions[t][None], row)
        obs = step.next_obs
        progress.count(1, t + 1 == len(shot.actions))
    for _ in range(HOLD):
        video.add(enlarged(frame_of(env)))
