"""The film of a report: episodes that were written down are played again, and drawn."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from skillweave.envs.engine import GymnasiumEngine
from skillweave.envs.make import EnvSpec
from skillweave.errors import EnvError
from skillweave.reporting.progress import EpisodeProgress
from skillweave.reporting.screen import without_screen
from skillweave.reporting.video import enlarged, frame_of
from skillweave.reporting.video_file import VideoWriter
from skillweave.training.played_episodes import Episode

MOST_FRAMES = 1_500
MOST_BYTES = 2_800_000  # as text in the page a third more
HOLD = 12  # frames for which the end of an episode stays
USUAL_FPS = 30


@dataclass(frozen=True)
class Film:
    """An MP4 of several episodes, one after another."""

    data: bytes
    fps: float
    """Frames per second."""
    every: int
    """Steps per frame."""
    first: dict[int, int]
    """By an episode's number, its first frame; it shows the start."""


@without_screen()
def make_film(
    spec: EnvSpec, episodes: Sequence[Episode], chosen: Sequence[int], *, quiet: bool = True
) -> Film:
    """Play the chosen episodes again from their seeds, with the same actions, and film them.

    Args:
        quiet: no progress.

    Raises:
        EnvError: the environment gives no frames, or does not repeat itself.
        MissingExtra: the extra 'video' is not installed.
    """
    env = spec.make(render_mode="rgb_array")
    engine = GymnasiumEngine(lambda number: env, 1, spec.name)
    steps = sum(len(episodes[i].rewards) for i in chosen)
    every = max(2, -(-steps // MOST_FRAMES))
    frames = steps // every + len(chosen) * (HOLD + 1)
    fps = (env.metadata.get("render_fps") or USUAL_FPS) / 2
    bits = int(8 * MOST_BYTES * fps / frames)
    first: dict[int, int] = {}
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "film.mp4"
            progress = EpisodeProgress(len(chosen), quiet=quiet, name="film")
            with VideoWriter(path, fps, bits) as video, progress:
                for i in chosen:
                    first[i] = video.frames
                    _replay(env, engine, episodes[i], video, every, progress)
            return Film(path.read_bytes(), fps, every, first)
    finally:
        engine.close()


def _replay(
    env: Any,
    engine: GymnasiumEngine,
    episode: Episode,
    video: VideoWriter,
    every: int,
    progress: EpisodeProgress,
) -> None:
    row = np.arange(1)
    engine.reset_some(row, [episode.seed])
    for i, (action, reward) in enumerate(zip(episode.actions, episode.rewards, strict=True)):
        if i % every == 0:
            video.add(enlarged(frame_of(env)))
        raw = engine.step(action[None], row)
        progress.count(1, i + 1 == len(episode.actions))
        over = bool(raw.terminated[0] | raw.truncated[0])
        if float(raw.reward[0]) != reward or (over and i + 1 < len(episode.actions)):
            raise EnvError(
                f"from seed {episode.seed} and with the same actions, the environment did another "
                f"thing in step {i + 1}: it does not repeat itself"
            )
    for _ in range(HOLD):
        video.add(enlarged(frame_of(env)))
