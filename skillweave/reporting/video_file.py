"""Video files, written frame by frame."""

from __future__ import annotations

import importlib
import os
import struct
import subprocess
from contextlib import suppress
from pathlib import Path
from subprocess import PIPE
from typing import Any, Self

import numpy as np

from skillweave.errors import DeclarationError, EnvError, RunError, needs_extra
from skillweave.policies.core import Array
from skillweave.reporting.palette import OWN_COLORS
from skillweave.runs.files import written


class VideoWriter:
    """A writer of a video, frame by frame; the file appears only when it is complete.

    Args:
        path: ends in .gif or .mp4. An existing file is replaced at the end, and stays as it is
            if the writing fails or is interrupted.
        fps: frames per second.
        most_bits: most bits per second of an MP4; None: no limit.

    Raises:
        DeclarationError: the path has another suffix.
        EnvError: frames are of unlike sizes.
        RunError: there is no frame at all, or the file cannot be written.
        MissingExtra: the library for this kind of file is not installed.
    """

    def __init__(self, path: str | Path, fps: float, most_bits: int | None = None) -> None:
        self.path = Path(path)
        self.frames = 0
        suffix = self.path.suffix.lower()
        if suffix not in (".gif", ".mp4"):
            raise DeclarationError(f"cannot write a video to {path}: it must end in .gif or .mp4")
        # In the same folder, since renaming works only within a file system, and with the suffix
        # last, since ffmpeg goes by it.
        self._part = self.path.with_name(f".{self.path.stem}.{os.getpid()}{self.path.suffix}")
        self._shape: tuple[int, ...] | None = None
        gif = suffix == ".gif"
        with written(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._sink = _Gif(self._part, fps) if gif else _Mp4(self._part, fps, most_bits)

    def add(self, frame: Array, seconds: float | None = None) -> None:
        """Append a frame (H, W, 3) uint8 that stays for ``seconds``, by default 1 / fps."""
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            raise EnvError(f"a frame is (H, W, 3) uint8, not {frame.shape} {frame.dtype}")
        if frame.shape != (self._shape or frame.shape):
            raise EnvError(f"the frames' size changed from {self._shape} to {frame.shape}")
        self._shape = frame.shape
        with written(self.path):
            self._sink.add(frame, seconds)
        self.frames += 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Close the video file and give it its name; remove it if an error ended the block."""
        try:
            if kind is not None:
                with suppress(OSError):  # the error that ended the block is raised
                    self._sink.close(complete=False)
                return
            with written(self.path):
                self._sink.close(complete=True)
            if not self.frames:
                raise RunError(f"no frames were given for {self.path}")
            with written(self.path):
                os.replace(self._part, self.path)
        finally:
            with suppress(OSError):
                self._part.unlink(missing_ok=True)


class _Mp4:
    """H.264 as every browser plays it, through a pipe to ffmpeg."""

    def __init__(self, path: Path, fps: float, most_bits: int | None) -> None:
        self._ffmpeg = extra("imageio_ffmpeg").get_ffmpeg_exe()
        self._path = path
        self._fps = fps
        self._most_bits = most_bits
        self._process: Any = None

    def add(self, frame: Array, seconds: float | None) -> None:
        """Write a frame into an MP4, by ffmpeg."""
        # The colours have half the resolution, so both sides must be even.
        frame = np.pad(frame, [(0, n % 2) for n in frame.shape[:2]] + [(0, 0)], mode="edge")
        if self._process is None:
            size = f"{frame.shape[1]}x{frame.shape[0]}"
            raw = f"-y -loglevel error -f rawvideo -pix_fmt rgb24 -s {size} -r {self._fps} -i -"
            coded = "-c:v libx264 -crf 20 -pix_fmt yuv420p -movflags +faststart"
            if self._most_bits is not None:
                most = self._most_bits
                coded += f" -preset veryfast -maxrate {most} -bufsize {most // 2}"
            command = [self._ffmpeg, *raw.split(), *coded.split(), str(self._path)]
            self._process = subprocess.Popen(command, stdin=PIPE, stderr=PIPE)
        try:
            for _ in range(1 if seconds is None else max(1, round(seconds * self._fps))):
                self._process.stdin.write(frame.tobytes())
        except BrokenPipeError:
            self.close(complete=True)

    def close(self, complete: bool) -> None:
        """Close the MP4; raise a RunError where ffmpeg could not write it."""
        process = self._process
        self._process = None
        complaint = process.communicate()[1] if process else b""
        if complete and process and process.returncode:
            raise RunError(f"ffmpeg could not write {self._path}: {complaint.decode()}")


class _Gif:
    """An endless GIF, streamed; each frame holds only what has changed since the one before."""

    CLEAR = 255  # the index that leaves a pixel as it is

    def __init__(self, path: Path, fps: float) -> None:
        self._image = extra("PIL.Image")
        self._codec = extra("PIL.GifImagePlugin")
        self._file = path.open("wb")
        self._fps = fps
        self._due = 0.0  # hundredths of a second
        self._written = 0  # hundredths of a second
        self._table: Any = None
        self._shown: Array = np.empty(0)  # (H, W) uint8

    def add(self, frame: Array, seconds: float | None) -> None:
        """Write a frame into a GIF: only the part that has changed."""
        image = self._image.fromarray(frame)
        if self._table is None:
            self._start(image)
        index = np.array(image.quantize(palette=self._table, dither=self._image.Dither.NONE))
        index[index == self.CLEAR] = 0  # the same colour, see `_start`
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
        """Start a GIF with one palette for all frames, or colours would flicker.

        The captions' own colours, so that text stays crisp, a cube for whatever is to come, and
        the best for the first frame. ``CLEAR`` repeats the first, and so shows nothing of its own.
        """
        captions = np.reshape(OWN_COLORS, (-1, 3))
        cube = np.indices((5, 5, 5)).reshape(3, -1).T
        best = first.quantize(self.CLEAR - len(captions) - len(cube)).getpalette()
        palette = np.concatenate([captions, cube * 255 // 4, np.reshape(best, (-1, 3))])
        colors = np.zeros((256, 3), np.uint8)
        colors[: len(palette)] = palette
        self._table = self._image.new("P", (1, 1))
        self._table.putpalette(colors.tobytes())
        self._shown = np.full(first.size[::-1], self.CLEAR, np.uint8)
        screen = struct.pack("<HHBBB", *first.size, 0xF7, 0, 0)
        endless = b"!\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00"
        self._file.write(b"GIF89a" + screen + colors.tobytes() + endless)

    def close(self, complete: bool) -> None:
        with self._file:
            self._file.write(b";")


def _extent(changed: Array) -> slice:
    """Return the range of true entries; one at least, as GIF has no empty frames."""
    at = np.flatnonzero(changed)
    return slice(int(at[0]), int(at[-1]) + 1) if len(at) else slice(0, 1)


def extra(module: str) -> Any:
    """Return a module of the extra 'video'; MissingExtra where it is not installed."""
    with needs_extra("drawing captions and writing videos", "video"):
        return importlib.import_module(module)
