"""Drawing on a machine without a screen: what is set meanwhile, and what is said where it fails."""

from __future__ import annotations

import contextlib
import ctypes.util
import os
import sys

import pytest

from skillweave.recipes import shuttle
from skillweave.reporting import screen

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is a screen")


@pytest.fixture(autouse=True)
def no_screen(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER", "MUJOCO_GL"):
        monkeypatch.setenv(name, "")  # so that monkeypatch restores it
        monkeypatch.delenv(name)


@pytest.mark.parametrize("installed", [True, False])
def test_mujoco_is_told_to_draw_with_egl_meanwhile_where_it_is_installed(monkeypatch, installed):
    monkeypatch.setattr(screen, "_has_egl", lambda: installed)
    with contextlib.suppress(ZeroDivisionError), screen.without_screen():
        assert os.environ.get("MUJOCO_GL") == ("egl" if installed else None)
        assert os.environ["SDL_VIDEODRIVER"] == "dummy"
        raise ZeroDivisionError
    assert not {"MUJOCO_GL", "SDL_VIDEODRIVER"} & os.environ.keys()


def test_what_the_user_has_set_stays_and_with_a_screen_nothing_is_set(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setenv("MUJOCO_GL", "osmesa")
        with screen.without_screen():
            assert os.environ["MUJOCO_GL"] == "osmesa"
        assert os.environ["MUJOCO_GL"] == "osmesa"
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(screen, "_has_egl", lambda: True)
    with screen.without_screen():
        assert not {"MUJOCO_GL", "SDL_VIDEODRIVER"} & os.environ.keys()


@pytest.mark.parametrize(
    "told",
    [
        "an OpenGL platform library has not been loaded into this process",
        "'NoneType' object has no attribute 'eglQueryString'",
    ],
)
def test_errors_of_opengl_have_a_hint(monkeypatch, told):
    assert "MUJOCO_GL is not set" in screen.hint(RuntimeError(told))
    monkeypatch.setenv("MUJOCO_GL", "egl")
    assert "MUJOCO_GL is 'egl'" in screen.hint(RuntimeError(told))
    assert screen.hint(RuntimeError("no light here")) == ""


@pytest.mark.slow
def test_the_half_cheetah_is_drawn_by_a_camera_that_stands_still():
    pytest.importorskip("mujoco")
    if ctypes.util.find_library("EGL") is None:
        pytest.skip("no EGL here")
    with screen.without_screen():
        env = shuttle.declare().spec.make(render_mode="rgb_array")
        try:
            env.reset(seed=0)
            first = env.render()
            world = env.unwrapped
            far = world.data.qpos.copy()
            far[0] += 30.0
            world.set_state(far, world.data.qvel)
            gone = env.render()
            assert world.mujoco_renderer.camera_id == -1  # it stands still: nobody is in sight
        finally:
            env.close()
    assert first.shape == gone.shape == (240, 640, 3)
    assert (first != gone).any(axis=2).sum() > 500
    moved = (first != gone).any(axis=(0, 2)).nonzero()[0]
    assert 200 < moved.min() < moved.max() < 440, "in the middle, at x = 0"
