"""Videos of a policy at work: who acts is written under every frame."""

from __future__ import annotations

import functools
import importlib
import os
import struct
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from subprocess import PIPE
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeAlias

import gymnasium as gym
import numpy as np

from skillweave.seeding import Seeds
from skillweave.types import Array, Memory, MissingExtra, Policy, SkillweaveError, Step

if TYPE_CHECKING:
    from skillweave.envs.make import EnvSpec

RGB: TypeAlias = tuple[int, int, int]

# From Okabe & Ito (2008), without the yellow that is lost on white, and four more, chosen to be
# far from these and from each other as people with a protan, deutan or tritan deficiency see them
# (Machado et al. 2009). Each has a contrast of at least 3 to black and 1.9 to white.
PALETTE: tuple[RGB, ...] = (
    (230, 159, 0), (0, 114, 178), (210, 0, 60), (142, 202, 112), (120, 0, 255),
    (86, 180, 233), (0, 158, 115), (213, 94, 0), (204, 121, 167), (135, 105, 255),
)  # fmt: skip
WHITE, BLACK = (255, 255, 255), (0, 0, 0)
BAND, LINE = (28, 28, 32), (110, 110, 118)  # a caption's ground, and what parts it from the frame
MIN_WIDTH, MAX_WIDTH = 240, 960  # pixels; smaller frames are enlarged, larger ones reduced
UNLIMITED = 10_000  # steps after which an episode is cut that nothing else would end
HOLD = 1.0  # seconds that the last frame of an episode stands


def color_of(index: int, wanted: RGB | None = None) -> RGB:
    """The colour of skill number ``index``: the one it asks for, else the palette's."""
    return PALETTE[index % len(PALETTE)] if wanted is None else wanted


def caption(
    frame: Array, text_left: str, color: RGB, text_right: str, size: int | None = None
) -> Array:
    """The frame on top of a dark band: a chip with who acts on its left, text on its right.

    Nothing of the frame is covered. A frame narrower than ``MIN_WIDTH`` is enlarged k times. A
    left text too long for its room is shortened; where it is empty there is no chip.

    Args:
        frame: (H, W, 3) uint8.
        size: of the font, in pixels; None: in proportion to the frame.

    Returns:
        (H·k + band, W·k, 3) uint8, of even height.
    """
    factor = -(-MIN_WIDTH // frame.shape[1])
    if factor > 1:
        frame = frame.repeat(factor, axis=0).repeat(factor, axis=1)
    height, width = frame.shape[:2]
    size = size or min(max(round(min(height / 22, width / 28)), 12), 40)
    band, margin = round(1.8 * size), size // 2
    band += (height + band) % 2
    out = np.empty((height + band, width, 3), np.uint8)
    out[:height], out[height], out[height + 1 :] = frame, LINE, BAND
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
    return _extra("PIL.ImageFont").load_default(size=size)


@functools.lru_cache(maxsize=256)
def _text(text: str, size: int, ink: RGB, ground: RGB) -> Array:
    """One line of text, (line height, its width, 3)."""
    font = _font(size)
    box = (max(1, round(font.getlength(text))), sum(font.getmetrics()))
    image = _extra("PIL.Image").new("RGB", box, ground)
    _extra("PIL.ImageDraw").Draw(image).text((0, 0), text, fill=ink, font=font)
    return np.asarray(image)


@functools.lru_cache(maxsize=256)
def _chip(text: str, color: RGB, size: int, width: int) -> Array:
    """A name on its colour, at most ``width`` pixels wide."""
    # Black and white contrast equally with a relative luminance of 0.18 (WCAG 2).
    luminance = (np.asarray(color) / 255) ** 2.2 @ (0.2126, 0.7152, 0.0722)
    short, pad = text, size // 2
    while text and _font(size).getlength(short) > width - 2 * pad:
        text = text[:-1]
        short = f"{text}..." if text else ""
    name = _text(short, size, BLACK if luminance > 0.18 else WHITE, color)
    chip = np.full((name.shape[0] + 2, name.shape[1] + 2 * pad, 3), color, np.uint8)
    _paste(chip, name, pad)
    return chip


class VideoWriter:
    """Writes a video frame by frame; the file appears only when all of it is there.

    Args:
        path: ends in .gif or .mp4. An existing file is replaced at the end, and stays as it is
            if the writing fails or is interrupted.
        fps: frames per second.

    Raises:
        SkillweaveError: another suffix, frames of unlike sizes, or no frame at all.
        MissingExtra: the library for this kind of file is not installed.
    """

    def __init__(self, path: str | Path, fps: float) -> None:
        self.path, self.frames = Path(path), 0
        kinds: dict[str, type[_Gif] | type[_Mp4]] = {".gif": _Gif, ".mp4": _Mp4}
        kind = kinds.get(self.path.suffix.lower())
        if kind is None:
            raise SkillweaveError(f"cannot write a video to {path}: it must end in .gif or .mp4")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        # In the same folder, since renaming works only within a file system, and with the suffix
        # last, since ffmpeg goes by it.
        self._part = self.path.with_name(f".{self.path.stem}.{os.getpid()}{self.path.suffix}")
        self._shape: tuple[int, ...] | None = None
        self._sink = kind(self._part, fps)

    def add(self, frame: Array, seconds: float | None = None) -> None:
        """Append a frame (H, W, 3) uint8 that stands for ``seconds``, by default 1 / fps."""
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            raise SkillweaveError(f"a frame is (H, W, 3) uint8, not {frame.shape} {frame.dtype}")
        if frame.shape != (self._shape or frame.shape):
            raise SkillweaveError(f"the frames' size changed from {self._shape} to {frame.shape}")
        self._shape = frame.shape
        self._sink.add(frame, seconds)
        self.frames += 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self._sink.close(complete=kind is None)
            if kind is None and not self.frames:
                raise SkillweaveError(f"no frames were given for {self.path}")
            if kind is None:
                os.replace(self._part, self.path)
        finally:
            self._part.unlink(missing_ok=True)


class _Mp4:
    """H.264 as every browser plays it, through a pipe to ffmpeg."""

    def __init__(self, path: Path, fps: float) -> None:
        self._ffmpeg = _extra("imageio_ffmpeg").get_ffmpeg_exe()
        self._path, self._fps = path, fps
        self._process: Any = None

    def add(self, frame: Array, seconds: float | None) -> None:
        # The colours have half the resolution, so both sides must be even.
        frame = np.pad(frame, [(0, n % 2) for n in frame.shape[:2]] + [(0, 0)], mode="edge")
        if self._process is None:
            size = f"{frame.shape[1]}x{frame.shape[0]}"
            raw = f"-y -loglevel error -f rawvideo -pix_fmt rgb24 -s {size} -r {self._fps} -i -"
            coded = "-c:v libx264 -crf 20 -pix_fmt yuv420p -movflags +faststart"
            command = [self._ffmpeg, *raw.split(), *coded.split(), str(self._path)]
            self._process = subprocess.Popen(command, stdin=PIPE, stderr=PIPE)
        try:
            for _ in range(1 if seconds is None else max(1, round(seconds * self._fps))):
                self._process.stdin.write(frame.tobytes())
        except BrokenPipeError:
            self.close(complete=True)

    def close(self, complete: bool) -> None:
        process, self._process = self._process, None
        complaint = process.communicate()[1] if process else b""
        if complete and process and process.returncode:
            raise SkillweaveError(f"ffmpeg could not write {self._path}: {complaint.decode()}")


class _Gif:
    """An endless GIF, streamed; each frame holds only what has changed since the one before."""

    CLEAR = 255  # the index that leaves a pixel as it is

    def __init__(self, path: Path, fps: float) -> None:
        self._image, self._codec = _extra("PIL.Image"), _extra("PIL.GifImagePlugin")
        self._file, self._fps = path.open("wb"), fps
        self._due, self._written = 0.0, 0  # hundredths of a second
        self._table: Any = None
        self._shown: Array = np.empty(0)  # (H, W) uint8

    def add(self, frame: Array, seconds: float | None) -> None:
        image = self._image.fromarray(frame)
        if self._table is None:
            self._start(image)
        index = np.array(image.quantize(palette=self._table, dither=self._image.Dither.NONE))
        index[index == self.CLEAR] = 0
        changed = index != self._shown
        self._shown = index
        rows, columns = _extent(changed.any(1)), _extent(changed.any(0))
        patch = self._image.fromarray(np.where(changed, index, np.uint8(self.CLEAR))[rows, columns])
        patch.putpalette(self._table.getpalette())
        # What rounding to hundredths takes from one frame goes to the next. Browsers slow down
        # frames of less than two.
        self._due += 100 * (1 / self._fps if seconds is None else seconds)
        time = max(2, round(self._due) - self._written)
        self._written += time
        settings = {"duration": 10 * time, "disposal": 1, "transparency": self.CLEAR}
        self._file.writelines(self._codec.getdata(patch, (columns.start, rows.start), **settings))

    def _start(self, first: Any) -> None:
        """One palette for all, or colours would flicker.

        The captions' own colours, so that text stays crisp, a cube for whatever is to come, and
        the best for the first frame. ``CLEAR`` repeats the first, and so shows nothing of its own.
        """
        own, cube = (BAND, LINE, WHITE, BLACK, *PALETTE), np.indices((5, 5, 5)).reshape(3, -1).T
        best = first.quantize(self.CLEAR - len(own) - len(cube)).getpalette()
        wanted = np.concatenate([own, cube * 255 // 4, np.reshape(best, (-1, 3))])
        colors = np.full((256, 3), BAND, np.uint8)
        colors[: len(wanted)] = wanted
        self._table = self._image.new("P", (1, 1))
        self._table.putpalette(colors.tobytes())
        self._shown = np.full(first.size[::-1], self.CLEAR, np.uint8)
        screen = struct.pack("<HHBBB", *first.size, 0xF7, 0, 0)
        endless = b"!\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00"
        self._file.write(b"GIF89a" + screen + colors.tobytes() + endless)

    def close(self, complete: bool) -> None:
        self._file.write(b";")
        self._file.close()


def _extent(changed: Array) -> slice:
    """From the first to the last true entry; one at least, as GIF has no empty frames."""
    at = np.flatnonzero(changed)
    return slice(int(at[0]), int(at[-1]) + 1) if len(at) else slice(0, 1)


def _extra(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtra("drawing captions and writing videos", "video") from error


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
        max_steps: of an episode; None: the environment's own limit, at most ``UNLIMITED``.
        label: from the policy's memory after ``act`` to who acted, and its colour.
        fps: steps shown per second; None: as many as the environment says, so in real time.
        every: one frame for so many steps, and one for the end of each episode.
        rng: for ``act``; None: derived from ``seed``.

    Returns:
        ``path``, ``frames``, and ``episodes``: for each its ``return``, its ``length`` and, as
        ``skills``, how many steps each acted.

    Raises:
        SkillweaveError: the environment gives no frames; see VideoWriter for more.
        MissingExtra: the extra 'video' is not installed.
    """
    if episodes < 1 or every < 1:
        raise SkillweaveError(f"episodes={episodes} and every={every} must be at least 1")
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # else pygame looks for a screen
    act = functools.partial(
        policy.act, deterministic=deterministic, rng=rng or (Seeds(seed) / "render").numpy()
    )
    env, told = env_spec.make(render_mode="rgb_array"), []
    try:
        with VideoWriter(path, (fps or env.metadata.get("render_fps") or 30) / every) as video:
            for i in range(episodes):
                who, color, skills = "", BLACK, Counter[str]()
                for now in _play(env, policy, act, seed + i, max_steps or UNLIMITED):
                    if label is not None and not now.over:
                        who, color = label(now.memory)
                        skills[who] += 1
                    if now.over or now.elapsed % every == 0:
                        word = "final return" if now.over else "return"
                        text = f"step {now.elapsed}   {word} {now.total:+.1f}"
                        frame = caption(_frame(env), who, color, text)
                        video.add(frame, HOLD if now.over else None)
                told.append({"return": now.total, "length": now.elapsed, "skills": dict(skills)})
    finally:
        env.close()
    return {"path": str(path), "frames": video.frames, "episodes": told}


class _Moment(NamedTuple):
    memory: Memory  # after acting, where the episode is not over
    elapsed: int  # steps
    total: float  # the return so far
    over: bool


def _play(
    env: gym.Env[Any, Any], policy: Policy, act: Callable[..., Any], seed: int, limit: int
) -> Iterator[_Moment]:
    """An episode: a moment before each step, when the action is chosen, and one at the end."""
    obs, _ = env.reset(seed=seed)
    memory, total, elapsed, over = policy.start(1), 0.0, 0, False
    while not over and elapsed < limit:
        before = np.asarray(obs)[None]
        action, memory = act(memory, before)
        yield _Moment(memory, elapsed, total, False)
        first = int(action[0]) if isinstance(env.action_space, gym.spaces.Discrete) else action[0]
        obs, reward, terminated, truncated, info = env.step(first)
        elapsed, total, over = elapsed + 1, total + float(reward), terminated or truncated
        step = Step(
            before, action, np.asarray(obs)[None], np.array([reward], np.float32),
            np.array([terminated]), np.array([truncated]), np.zeros(1, bool),
            np.array([elapsed]), {key: _batch_of_one(value) for key, value in info.items()},
        )  # fmt: skip
        memory = policy.observe(memory, step)
    yield _Moment(memory, elapsed, total, True)


def _batch_of_one(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value[None]
    return np.array([value]) if np.isscalar(value) else [value]


def _frame(env: gym.Env[Any, Any]) -> Array:
    """What the environment shows now, reduced to at most ``MAX_WIDTH``."""
    frame: Any = env.render()
    if not isinstance(frame, np.ndarray):
        raise SkillweaveError(f"{env} cannot be filmed: render() gave {type(frame).__name__}")
    factor = -(-frame.shape[1] // MAX_WIDTH)
    return frame if factor == 1 else np.asarray(_extra("PIL.Image").fromarray(frame).reduce(factor))
