"""Videos of a policy at work, with the acting skill's name under every frame."""

from __future__ import annotations

import base64
import functools
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.messages import error_text
from skillweave._internal.notebooks import Markup, joined, paragraph
from skillweave._internal.policy_protocol import Memory, Policy
from skillweave._internal.seeding import Seeds, global_generators
from skillweave._internal.terminal import printable
from skillweave.envs.checked import LONG_EPISODE
from skillweave.envs.engine import GymnasiumEngine
from skillweave.envs.make import EnvSpec
from skillweave.errors import EnvError
from skillweave.experience.play import PlayedStep, SeededEpisodes, play
from skillweave.policies.core import Array
from skillweave.reporting.palette import BAND, BLACK, LINE, RGB, WHITE, is_light
from skillweave.reporting.progress import EpisodeProgress
from skillweave.reporting.screen import hint, without_screen
from skillweave.reporting.video_file import VideoWriter, extra
from skillweave.schema import AtLeastOne, Count, fitted

MAX_WIDTH = 960  # pixels; larger frames are reduced
MIN_WIDTH = 240  # pixels; smaller frames are enlarged
EVERY = 2  # steps for each frame; each episode's end has a frame of its own
HOLD = 1.0  # seconds for which the last frame of an episode stays
LARGEST = 50_000_000
"""Bytes of a film that a notebook shows: it keeps a copy inside."""


@without_screen()
def render_policy(
    env_spec: EnvSpec,
    policy: Policy,
    path: str | Path,
    label: Callable[[Memory], tuple[str, RGB, str]],
    *,
    episodes: int = 1,
    seed: int = 0,
    deterministic: bool = True,
    max_steps: int | None = None,
    quiet: bool = False,
) -> Film:
    """Run a policy on Gymnasium's environment and write a captioned video of it, in real time.

    Args:
        label: from the policy's memory after ``act`` to the acting skill's name, colour and goal.
        seed: episode i starts from ``reset(seed=seed + i)``.
        max_steps: of an episode; None: the environment's own limit, at most ``LONG_EPISODE``.
        quiet: no progress.

    Returns:
        The film, with facts about each episode: its ``return``, its ``length``, whether it was
        ``cut`` before its end and, as ``skills``, how many steps each acted.

    Raises:
        EnvError: the environment gives no frames; see VideoWriter for more.
        MissingExtra: the extra 'video' is not installed.
    """
    episodes = fitted(AtLeastOne, episodes, "episodes")
    seed = fitted(Count, seed, "seed")
    max_steps = LONG_EPISODE if max_steps is None else fitted(AtLeastOne, max_steps, "max_steps")
    how: Any = {"deterministic": deterministic, "rng": np.random.default_rng(seed)}
    with global_generators(Seeds(seed) / "render" / "global"):
        env = env_spec.make(render_mode="rgb_array")
        # Observations, infos and masks are as in an evaluation.
        engine = GymnasiumEngine(lambda number: env, 1, env_spec.name)
        try:
            with (
                VideoWriter(path, (env.metadata.get("render_fps") or 30) / EVERY) as video,
                EpisodeProgress(episodes, quiet=quiet, name="film") as progress,
            ):
                record = _Record(env, video, label)
                whole = SeededEpisodes(engine, range(seed, seed + episodes), max_steps)
                for played in play(policy, whole, before_step=record.before_step, **how):
                    record.after_step(played)
                    progress.watch(played)
        finally:
            engine.close()
    return Film(path=str(path), frames=video.frames, episodes=record.episodes)


class _Record:
    """Frames of episodes as they are played, and the facts about each."""

    def __init__(
        self,
        env: gym.Env[Any, Any],
        video: VideoWriter,
        label: Callable[[Memory], tuple[str, RGB, str]],
    ) -> None:
        self.env = env
        self.video = video
        self.label = label
        self.episodes: list[dict[str, Any]] = []
        self._begin()

    def _begin(self) -> None:
        self._elapsed = 0
        self._total = 0.0
        self._skills = Counter[str]()

    def before_step(self, memory: Memory) -> None:
        """Show what the policy is about to do."""
        skill, self._color, goal = self.label(memory)
        self._acting = f"{skill} {goal}" if goal else skill
        self._skills[skill] += 1
        if self._elapsed % EVERY == 0:
            self._show("return")

    def after_step(self, played: PlayedStep) -> None:
        """Count the step, and show an episode's end."""
        self._elapsed += 1
        self._total += float(played.reward[0])
        if played.over[0]:
            self._show("final return", HOLD)
            self.episodes.append(
                {
                    "return": self._total,
                    "length": self._elapsed,
                    "cut": bool(played.cut[0]),
                    "skills": dict(self._skills),
                }
            )
            self._begin()

    def _show(self, word: str, seconds: float | None = None) -> None:
        text = f"step {self._elapsed}   {word} {self._total:+.1f}"
        self.video.add(caption(frame_of(self.env), self._acting, self._color, text), seconds)


def frame_of(env: gym.Env[Any, Any]) -> Array:
    """Return the environment's picture, (H, W, 3) uint8, reduced to at most ``MAX_WIDTH``.

    Raises:
        EnvError: ``render`` failed, or gave no such picture.
    """
    name = type(env.unwrapped).__name__
    try:
        frame: Any = env.render()
    except (Exception, SystemExit) as error:
        raise EnvError(
            f"{name} cannot be filmed: its render() raised {error_text(error)}.{hint(error)}"
        ) from error
    if not isinstance(frame, np.ndarray):
        raise EnvError(f"{name} cannot be filmed: render() gave {type(frame).__name__}")
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or not frame.size:
        raise EnvError(
            f"{name} cannot be filmed: render() gave {frame.dtype} of shape {frame.shape}; let it "
            "return uint8 of shape (height, width, 3): red, green and blue from 0 to 255"
        )
    factor = -(-frame.shape[1] // MAX_WIDTH)
    return frame if factor == 1 else np.asarray(extra("PIL.Image").fromarray(frame).reduce(factor))


class Film(dict[str, Any]):
    """A film's ``path``, ``frames`` and ``episodes``. A notebook shows the film."""

    def __repr__(self) -> str:
        returns = ", ".join(f"{episode['return']:.1f}" for episode in self["episodes"])
        return printable(f"<Film {self['path']}: {self['frames']:,} frames, return {returns}>")

    def _repr_html_(self) -> str:
        """Return the film as a part of the page."""
        path = Path(self["path"])
        caption = paragraph(repr(self).strip("<>"))
        try:
            data = path.read_bytes() if path.stat().st_size <= LARGEST else None
        except OSError as error:
            return joined([caption, paragraph(f"The film cannot be read: {error.strerror}.")])
        if data is None:
            return joined([caption, paragraph("It is too large to be shown here.")])
        text = base64.b64encode(data).decode()
        if path.suffix.lower() == ".gif":
            shown = f'<img src="data:image/gif;base64,{text}" style="max-width: 100%">'
        else:
            source = f"data:video/mp4;base64,{text}"
            shown = f'<video src="{source}" controls loop muted style="max-width: 100%"></video>'
        return joined([Markup(shown), caption])


def enlarged(frame: Array) -> Array:
    """Return a frame (H, W, 3) enlarged k times, so that it has at least ``MIN_WIDTH`` pixels."""
    factor = -(-MIN_WIDTH // frame.shape[1])
    return frame if factor <= 1 else frame.repeat(factor, axis=0).repeat(factor, axis=1)


# Captions


def caption(frame: Array, text_left: str, color: RGB, text_right: str) -> Array:
    """Return a film's frame above a dark band: the acting skill on its left, text on its right.

    Nothing of the frame is covered. A frame narrower than ``MIN_WIDTH`` is enlarged k times. A
    left text too long for its room is shortened; where it is empty there is no chip.

    Args:
        frame: (H, W, 3) uint8.

    Returns:
        (H·k + band, W·k, 3) uint8, of even height.
    """
    frame = enlarged(frame)
    height, width = frame.shape[:2]
    size = min(max(round(min(height / 22, width / 28)), 12), 40)  # of the font
    band = round(1.8 * size)
    margin = size // 2
    band += (height + band) % 2
    out = np.empty((height + band, width, 3), np.uint8)
    out[:height] = frame
    out[height] = LINE
    out[height + 1 :] = BAND
    right = _text(text_right, size, WHITE, BAND)[:, : width - 2 * margin]
    room = width - 2 * margin - right.shape[1]
    _paste(out[height + 1 :], right, margin + room)
    if text_left and room > 2 * size:
        _paste(out[height + 1 :], _chip(text_left, color, size, room - size), margin)
    return out


def _paste(band: Array, patch: Array, left: int) -> None:
    top = (band.shape[0] - patch.shape[0]) // 2
    band[top : top + patch.shape[0], left : left + patch.shape[1]] = patch


@functools.lru_cache(maxsize=16)
def _font(size: int) -> Any:
    return extra("PIL.ImageFont").load_default(size=size)


@functools.lru_cache(maxsize=256)
def _text(text: str, size: int, ink: RGB, ground: RGB) -> Array:
    """Return one line of a caption's text as a picture (line height, its width, 3)."""
    font = _font(size)
    box = (max(1, round(font.getlength(text))), sum(font.getmetrics()))
    image = extra("PIL.Image").new("RGB", box, ground)
    extra("PIL.ImageDraw").Draw(image).text((0, 0), text, fill=ink, font=font)
    return np.asarray(image)


@functools.lru_cache(maxsize=256)
def _chip(text: str, color: RGB, size: int, width: int) -> Array:
    """Return a skill's name on its colour for a caption, at most ``width`` pixels wide."""
    short = text
    pad = size // 2
    while text and _font(size).getlength(short) > width - 2 * pad:
        text = text[:-1]
        short = f"{text}..." if text else ""
    name = _text(short, size, BLACK if is_light(color) else WHITE, color)
    chip = np.full((name.shape[0] + 2, name.shape[1] + 2 * pad, 3), color, np.uint8)
    _paste(chip, name, pad)
    return chip
