"""Drawing on a machine without a screen."""

from __future__ import annotations

import ctypes.util
import functools
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_screen() -> Iterator[None]:
    """Let environments draw without a screen on Linux, in this block or this function.

    Set pygame to use no screen, and MuJoCo to draw with EGL where that is installed. Both are
    undone at the end, as the user may wish to draw with something else.
    """
    if sys.platform != "linux" or {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        yield
        return
    added = {"SDL_VIDEODRIVER": "dummy"} | ({"MUJOCO_GL": "egl"} if _has_egl() else {})
    added = {name: value for name, value in added.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


@functools.cache
def _has_egl() -> bool:
    """Return whether the library EGL is installed, which draws without a screen."""
    return ctypes.util.find_library("EGL") is not None


def hint(error: BaseException) -> str:
    """Return advice, after a space, where OpenGL could not draw; else an empty text."""
    message = f"{type(error).__module__} {error}".lower()
    if sys.platform != "linux" or not any(
        k in message for k in ("opengl", "egl", "osmesa", "glfw")
    ):
        return ""
    now = os.environ.get("MUJOCO_GL")
    return (
        f" MuJoCo draws with OpenGL, and MUJOCO_GL is {'not set' if now is None else repr(now)}. "
        "On a machine without a screen install EGL (MUJOCO_GL=egl; Debian: libegl1) or OSMesa "
        "(MUJOCO_GL=osmesa; libosmesa6)"
    )
