"""Captions, video files, and a policy filmed."""

from __future__ import annotations

import errno
import itertools
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError, EnvError, MissingExtra, RunError
from skillweave.reporting.palette import PALETTE, color_of
from skillweave.reporting.video import caption, render_policy
from skillweave.reporting.video_file import VideoWriter
from skillweave.training.evaluation import evaluate
from skillweave.types import Array, Memory, Step

Image = pytest.importorskip("PIL.Image")

SIZE = (48, 60)  # of Corridor's frames: height, width


class Corridor(gym.Env[Array, int]):
    """Walk right for seven steps; each step pays one, and the ground turns from black to white."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012
    observation_space: gym.Space[Any] = gym.spaces.Box(0, 10, (1,), np.float32)
    action_space: gym.Space[Any] = gym.spaces.Discrete(2)

    def __init__(self, render_mode: str | None = None, length: int = 7) -> None:
        self.render_mode, self.length, self.at = render_mode, length, 0
        self.seeds: list[int | None] = []
        self.actions: list[Any] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.seeds.append(seed)
        self.at = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: int) -> Any:
        self.actions.append(action)
        self.at += 1
        return np.full(1, self.at, np.float32), 1.0, self.at == self.length, False, {"at": self.at}

    def render(self) -> Any:
        return np.full((*SIZE, 3), 255 * self.at // self.length, np.uint8)


class Walker:
    """Remembers how often it acted and all that it was told."""

    observation_space: gym.Space[Any] = Corridor.observation_space
    action_space: gym.Space[Any] = Corridor.action_space
    labels: tuple[str, ...] = ()

    def __init__(self) -> None:
        self.told: list[Step] = []
        self.asked: list[tuple[bool, Any]] = []

    def start(self, n: int) -> Memory:
        return {"acted": np.zeros(n, np.int64)}

    def act(
        self, memory: Memory, obs: Array, mask: Array | None = None, *,
        deterministic: bool = True, rng: np.random.Generator | None = None,
    ) -> tuple[Array, Memory]:  # fmt: skip
        assert obs.shape == (1, 1)
        self.asked.append((deterministic, rng))
        return np.array([1]), {"acted": memory["acted"] + 1}

    def observe(self, memory: Memory, step: Step) -> Memory:
        self.told.append(step)
        return memory

    def acting(self, memory: Memory) -> Array | None:
        return None


def label(memory: Memory) -> tuple[str, tuple[int, int, int], str]:
    """The first three steps are one skill's, the rest another's."""
    second = int(memory["acted"][0]) > 3
    return ("walk", "run")[second], color_of(second), ""


def render(env: Any, path: Path, policy: Any = None, **how: Any) -> dict[str, Any]:
    return render_policy(EnvSpec(env), policy or Walker(), path, label, **how)


def decode(path: Path) -> tuple[list[Array], list[int]]:
    """A GIF's frames, (H, W, 3) each, and how long each stands in milliseconds."""
    frames, durations = [], []
    with Image.open(path) as gif:
        assert gif.info["loop"] == 0
        for i in range(gif.n_frames):
            gif.seek(i)
            frames.append(np.asarray(gif.convert("RGB")))
            durations.append(gif.info["duration"])
    return frames, durations


def has(region: Array, color: tuple[int, int, int]) -> bool:
    return bool((np.abs(region.astype(int) - color).max(-1) <= 4).sum() > 20)


def luminance(color: tuple[int, int, int]) -> float:
    share = np.array(color) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def test_palette_is_distinct_and_readable_on_black_and_on_white():
    for a, b in itertools.combinations(PALETTE, 2):
        assert np.abs(np.subtract(a, b)).max() > 40, (a, b)
    for color in PALETTE:
        assert (luminance(color) + 0.05) / 0.05 >= 3
        assert 1.05 / (luminance(color) + 0.05) >= 1.9
    assert color_of(0) != color_of(1)
    assert color_of(len(PALETTE) + 1) == PALETTE[1]
    assert color_of(3, (0, 0, 0)) == (0, 0, 0)


@pytest.mark.parametrize("shape", [(400, 600), (64, 64), (84, 84), (210, 160), (721, 1281)])
@pytest.mark.parametrize("ground", [0, 255])
def test_caption_leaves_the_frame_and_shows_the_color(shape, ground):
    frame = np.full((*shape, 3), ground, np.uint8)
    frame[::7] = 99
    out = caption(frame, "landing", PALETTE[0], "step 132   return +87.4")
    k = out.shape[1] // shape[1]
    assert out.shape[1] == k * shape[1] >= 240
    assert out.shape[0] % 2 == 0
    assert (out[: k * shape[0]] == frame.repeat(k, 0).repeat(k, 1)).all()
    band = out[k * shape[0] :]
    assert 0.04 < band.shape[0] / out.shape[0] < 0.16
    assert has(band[:, : out.shape[1] // 2], PALETTE[0])
    assert has(band[:, out.shape[1] // 2 :], (255, 255, 255))


def test_caption_tells_skills_steps_and_returns_apart():
    frame = np.zeros((400, 600, 3), np.uint8)
    first = caption(frame, "landing", PALETTE[0], "step 1   return +0.5")
    assert (first != caption(frame, "hovering", PALETTE[0], "step 1   return +0.5")).any()
    assert (first != caption(frame, "landing", PALETTE[0], "step 2   return +0.5")).any()
    assert (first != caption(frame, "landing", PALETTE[0], "step 1   return -0.5")).any()
    other = caption(frame, "landing", PALETTE[1], "step 1   return +0.5")
    assert has(other, PALETTE[1])
    assert not has(other, PALETTE[0])
    assert not has(caption(frame, "", PALETTE[0], "step 1"), PALETTE[0])


@pytest.mark.parametrize("width", [60, 84, 240, 600])
def test_a_long_name_never_reaches_the_text_on_the_right(width):
    frame, text = np.zeros((width, width, 3), np.uint8), "step 1032   return -187.4"
    bare = caption(frame, "", PALETTE[1], text)
    named = caption(frame, "x" * 64, PALETTE[1], text)
    changed = np.flatnonzero((bare != named).any((0, 2)))
    white = np.flatnonzero((bare > 200).all(-1).any(0))
    assert changed.size
    assert changed.max() < white.min()


def test_captions_on_dark_chips_are_white_and_on_light_ones_black():
    frame = np.zeros((400, 600, 3), np.uint8)
    for color, ink in (((0, 0, 120), (255, 255, 255)), ((250, 240, 200), (0, 0, 0))):
        assert has(caption(frame, "landing", color, "")[402:-2, 10:100], ink)


def test_gif_holds_every_frame(tmp_path):
    rng, path, written = np.random.default_rng(0), tmp_path / "a.gif", []
    frame = np.zeros((50, 70, 3), np.uint8)
    with VideoWriter(path, fps=30) as video:
        for i in range(12):
            y, x = rng.integers(40, size=2)
            frame[y : y + 8, x : x + 8] = PALETTE[i % len(PALETTE)]
            written.append(frame.copy())
            video.add(frame)
        video.add(frame)  # unchanged
        video.add(frame, seconds=1.5)
        video.add(np.full_like(frame, (200, 40, 90)))  # a colour that the first frame lacked
    *frames, last = decode(path)[0]
    assert len(frames) + 1 == video.frames == 15
    for got, wanted in zip(frames, [*written, frame, frame], strict=True):
        assert np.abs(got.astype(int) - wanted).max() <= 4
    assert np.abs(last.astype(int) - (200, 40, 90)).max() <= 32
    durations = decode(path)[1][:-1]
    assert durations[-1] == 1500
    assert abs(sum(durations[:-1]) - 13 * 1000 / 30) <= 10


def test_gif_stores_only_what_changes(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (100, 100, 3)).astype(np.uint8)
    sizes = []
    for n in (1, 50):
        with VideoWriter(tmp_path / "a.gif", fps=10) as video:
            for _ in range(n):
                video.add(noise)
        sizes.append((tmp_path / "a.gif").stat().st_size)
    assert sizes[1] < 1.5 * sizes[0]


def test_mp4_holds_every_frame_and_repeats_a_held_one(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "deep" / "a.mp4"
    with VideoWriter(path, fps=10) as video:
        for i in range(5):
            video.add(np.full((65, 81, 3), 40 * i, np.uint8))
        video.add(np.full((65, 81, 3), 255, np.uint8), seconds=1.0)
    # Not with `ffmpeg.read_frames`, which leaves its pipes open where ffmpeg is quick to end.
    command = [ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    assert b"82x66" in done.stderr
    assert b"10 fps" in done.stderr
    frames = np.frombuffer(done.stdout, np.uint8).reshape(-1, 66, 82, 3)
    assert [round(float(f.mean()) / 40) for f in frames] == [0, 1, 2, 3, 4, *[6] * 10]


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
@pytest.mark.parametrize("error", [FileNotFoundError, KeyboardInterrupt])  # not of this file
def test_a_failed_write_leaves_the_old_file(tmp_path, suffix, error):
    if suffix == ".mp4":
        pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"precious")

    def interrupted() -> None:
        with VideoWriter(path, fps=10) as video:
            for _ in range(3):
                video.add(np.zeros((64, 64, 3), np.uint8))
            raise error

    with pytest.raises(error):
        interrupted()
    assert path.read_bytes() == b"precious"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.skipif(sys.platform == "win32", reason="a shell script stands in for ffmpeg")
@pytest.mark.parametrize("reads", ["cat > /dev/null;", ""])
def test_when_ffmpeg_fails(tmp_path, monkeypatch, reads):
    pytest.importorskip("imageio_ffmpeg")
    fake, path = tmp_path / "ffmpeg", tmp_path / "a.mp4"
    fake.write_text(f"#!/bin/sh\n{reads} echo disk full >&2; exit 1\n")
    fake.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(fake))
    path.write_bytes(b"precious")

    def write() -> None:
        with VideoWriter(path, fps=10) as video:
            for _ in range(3):
                video.add(np.zeros((600, 600, 3), np.uint8))

    with pytest.raises(RunError, match="disk full"):
        write()
    assert path.read_bytes() == b"precious"
    assert {p.name for p in tmp_path.iterdir()} == {"a.mp4", "ffmpeg"}


def test_bad_videos_are_named(tmp_path):
    with pytest.raises(RunError, match="no frames"), VideoWriter(tmp_path / "a.gif", 10):
        pass
    frame = np.zeros((8, 8, 3), np.uint8)
    with VideoWriter(tmp_path / "a.gif", fps=10) as video:
        video.add(frame)
        with pytest.raises(EnvError, match="size changed"):
            video.add(frame[:4])
        with pytest.raises(EnvError, match="uint8"):
            video.add(frame / 255)
    (tmp_path / "file").write_text("mine")
    for name in ("film.gif", "film.mp4"):
        with pytest.raises(RunError, match="could not write"):
            VideoWriter(tmp_path / "file" / name, 10)


@pytest.mark.parametrize(("suffix", "module"), [("gif", "PIL.Image"), ("mp4", "imageio_ffmpeg")])
def test_a_missing_library_names_the_extra(tmp_path, monkeypatch, suffix, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtra, match=r"skillweave\[video\]"):
        VideoWriter(tmp_path / f"a.{suffix}", fps=10)
    assert not list(tmp_path.iterdir())


def test_render_policy(tmp_path):
    made = []

    def corridor(render_mode: str | None = None) -> Corridor:
        made.append(Corridor(render_mode))
        return made[0]

    path = tmp_path / "a.gif"
    result = render(corridor, path, episodes=2, seed=5)
    episode = {"return": 7.0, "length": 7, "cut": False, "skills": {"walk": 3, "run": 4}}
    assert result == {"path": str(path), "frames": 10, "episodes": [episode, episode]}
    assert made[0].seeds == [5, 6]
    assert made[0].actions == [1] * 14
    frames, durations = decode(path)
    # Steps 0, 2, 4, 6 and the end; 20 steps a second, every other one shown.
    assert durations == [100, 100, 100, 100, 1000] * 2
    for i, (skill, other) in enumerate([(0, 1), (0, 1), (1, 0), (1, 0), (1, 0)] * 2):
        band = frames[i][4 * SIZE[0] :]
        assert has(band, PALETTE[skill]), i
        assert not has(band, PALETTE[other]), i
    for i, at in enumerate([0, 2, 4, 6, 7]):
        assert abs(int(frames[i][10, 10, 0]) - 255 * at // 7) <= 16


def test_an_episode_is_cut_and_its_actions_are_sampled_where_that_is_asked(tmp_path):
    path, policy = tmp_path / "a.gif", Walker()
    result = render(Corridor, path, policy, max_steps=4, deterministic=False)
    assert not any(deterministic for deterministic, _ in policy.asked)
    assert isinstance(policy.asked[0][1], np.random.Generator)
    skills = {"walk": 3, "run": 1}
    assert result["episodes"] == [{"return": 4.0, "length": 4, "cut": True, "skills": skills}]
    assert decode(path)[1] == [100, 100, 1000]
    with pytest.raises(DeclarationError, match="at least 1"):
        render(Corridor, path, max_steps=0)


def test_wide_frames_are_reduced(tmp_path):
    class Wide(Corridor):
        def render(self) -> Any:
            return np.zeros((500, 2000, 3), np.uint8)

    render(Wide, tmp_path / "a.gif", max_steps=1)
    assert decode(tmp_path / "a.gif")[0][0].shape[1] == 667


@pytest.mark.parametrize(
    "picture",
    [
        None,
        np.ones((64, 64, 3), np.float32),
        *(np.ones(shape, np.uint8) for shape in [(64, 64), (64, 64, 4), (0, 0, 3)]),
    ],
)
def test_a_picture_that_is_not_rgb_is_refused_before_a_step(tmp_path, picture):
    class Odd(Corridor):
        step: Any = None

        def render(self) -> Any:
            return picture

    says = "NoneType" if picture is None else "uint8"
    with pytest.raises(EnvError, match=rf"Odd cannot be filmed: render\(\) gave .*{says}"):
        render(Odd, tmp_path / "a.gif")
    assert not list(tmp_path.iterdir())


def test_an_environment_that_fails_to_draw_is_named(tmp_path):
    class NoScreen(Corridor):
        def render(self) -> Any:
            raise RuntimeError("no light here.")

    told = r"NoScreen cannot be filmed: its render.. raised RuntimeError: no light here \(test_vid"
    with pytest.raises(EnvError, match=told) as caught:
        render(NoScreen, tmp_path / "a.gif")
    assert isinstance(caught.value.__cause__, RuntimeError)
    assert "MuJoCo" not in str(caught.value)


def test_a_real_environment_without_a_display(tmp_path, monkeypatch):
    pytest.importorskip("pygame")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.setenv(name, "")  # so that monkeypatch restores it
        monkeypatch.delenv(name)

    class Left(Walker):
        def act(self, memory: Memory, obs: Array, mask: Any = None, **_: Any) -> Any:
            return np.zeros(1, np.int64), memory

    result = render("CartPole-v1", tmp_path / "a.gif", Left(), seed=1)
    assert "SDL_VIDEODRIVER" not in os.environ, "it was set for the film alone"
    (episode,) = result["episodes"]
    frames, durations = decode(tmp_path / "a.gif")
    assert episode["length"] == episode["return"] < 30
    assert len(frames) == -(-episode["length"] // 2) + 1
    assert frames[0].shape == (432, 600, 3)
    assert durations[0] == 40
    assert (frames[0][:400] != frames[-1][:400]).any()


def test_a_film_shows_what_an_evaluation_plays(tmp_path):
    """Dict observations, nested infos and rewards reach a policy as they do elsewhere."""

    class Rooms(Corridor):
        observation_space = gym.spaces.Dict(
            at=gym.spaces.Box(0, 10, (1,), np.float32), room=gym.spaces.Discrete(20)
        )

        def told(self) -> Any:
            return {"room": self.at, "at": np.full(1, self.at, np.float32)}

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            super().reset(seed=seed)
            return self.told(), {}

        def step(self, action: int) -> Any:
            _, *rest = super().step(action)
            return self.told(), rest[0] + action / 3, *rest[1:3], {"deep": {"at": self.at}}

    class Reader(Walker):
        observation_space = Rooms.observation_space

        def act(self, memory: Memory, obs: Array, mask: Any = None, **_: Any) -> Any:
            assert obs["at"].shape == (len(obs), 1)
            return obs["room"] % 2, memory

    policies = Reader(), Reader()
    found = evaluate(policies[0], EnvSpec(Rooms), episodes=1)
    film = render(Rooms, tmp_path / "a.gif", policies[1])
    assert [e["return"] for e in film["episodes"]] == list(found.returns)
    told = [
        [
            (s.obs.tolist(), s.action.tolist(), s.next_obs.tolist(), s.reward.tolist(),
             s.elapsed.tolist(), s.info["deep"]["at"].tolist())
            for s in policy.told
        ]
        for policy in policies
    ]  # fmt: skip
    assert told[0] == told[1]
    assert len(told[0]) == 7


class Full:
    """A file on a full disk: it takes 2 kB."""

    def __init__(self, file: Any) -> None:
        self.file = file
        self.left = 2_000

    def __enter__(self) -> Full:
        return self

    def __exit__(self, *error: object) -> None:
        self.file.close()

    def write(self, data: bytes) -> None:
        self.left -= len(data)
        if self.left < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        self.file.write(data)

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)


@pytest.mark.parametrize("frames", [1, 5, 50])
def test_a_gif_on_a_full_disk_is_an_error_of_the_library_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, frames: int
) -> None:
    path = tmp_path / "film.gif"
    path.write_bytes(b"an earlier film")
    real = Path.open
    monkeypatch.setattr(Path, "open", lambda self, mode: Full(real(self, mode)))
    noise = np.random.default_rng(0).integers(0, 255, (frames, *SIZE, 3)).astype(np.uint8)

    def write() -> None:
        with VideoWriter(path, 10) as video:
            for frame in noise:
                video.add(frame)

    with pytest.raises(RunError, match=r"could not write .*film\.gif: No space left"):
        write()
    monkeypatch.undo()
    assert [p.name for p in tmp_path.iterdir()] == ["film.gif"]
    assert path.read_bytes() == b"an earlier film"
