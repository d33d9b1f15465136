"""What people see of training, on a terminal and without one."""

from __future__ import annotations

import io
import re
import subprocess
import sys
from contextlib import redirect_stderr
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from reporting.walkway import declare
from small_runs import stage_entry

from skillweave.reporting import progress as module
from skillweave.reporting.progress import EpisodeProgress, Progress


class Clock:
    """Stands in for ``time``: goes on only when told."""

    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    return clock


class Terminal(io.StringIO):
    """A text stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def terminal(monkeypatch):
    terminal = Terminal()
    for name in ("NO_COLOR", "CI", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "100")
    return terminal


def train(progress: Progress, clock: Clock, name: str = "landing", every: float = 0.5) -> None:
    """20 s of training at 1,000 steps/s, an update each half second."""
    progress.stage(name, 20_000)
    for i in range(1, int(20 / every) + 1):
        clock.now += every
        spent = every * i
        progress.tick(name, int(1000 * spent), spent, {"return": 10 * spent, "loss": 3.0})
    progress.done(name, 20_000, 20.0, {"return": 200.0})


def test_plain_lines(clock, capsys):
    with Progress() as progress:
        progress.message("run: runs/[7]")
        train(progress, clock)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == [
        "run: runs/[7]",
        "landing: training for 20,000 steps",
        "landing: 5,000 of 20,000 steps (25%), return 50.0, 1,000 steps/s, 0:15 left",
        "landing: 10,000 of 20,000 steps (50%), return 100.0, 1,000 steps/s, 0:10 left",
        "landing: 15,000 of 20,000 steps (75%), return 150.0, 1,000 steps/s, 0:05 left",
        "landing: 20,000 of 20,000 steps (100%), return 200.0, 1,000 steps/s, done in 0:20",
    ]


def test_speed_is_the_recent_one(clock, capsys):
    with Progress() as progress:
        progress.stage("landing", 100_000)
        progress.tick("landing", 50_000, 500.0, {})  # resumed; it was slow before
        clock.now += 6
        progress.tick("landing", 62_000, 506.0, {})
        clock.now += 20
        progress.tick("landing", 72_000, 526.0, {})
    lines = capsys.readouterr().err.splitlines()
    assert lines[-2] == "landing: 62,000 of 100,000 steps (62%), 2,000 steps/s, 0:19 left"
    assert lines[-1] == "landing: 72,000 of 100,000 steps (72%), 500 steps/s, 0:56 left"
    with Progress() as progress:
        progress.done("center", 5_000, 7322.0, {"return": -1.25})  # it had no start
    assert "return -1.2, 1 steps/s, done in 2:02:02" in capsys.readouterr().err


TOGETHER = {
    "return": 22.84, "selector.call_length": 5.25, "selector.entropy": 0.7, "left.usage": 0.25,
    "left.reward": 0.031, "inner/right.usage": 0.75, "inner/right.reward": -1.5, "idle.usage": 0.0,
}  # fmt: skip


def test_everyone_who_learns_in_a_stage_has_a_line_at_its_end(clock, capsys):
    with Progress() as progress:
        progress.stage("together", 10_000)
        clock.now += 6
        progress.tick("together", 5_000, 5.0, TOGETHER)
        progress.done("together", 10_000, 10.0, TOGETHER)
    assert capsys.readouterr().err.splitlines()[1:] == [
        "together: 5,000 of 10,000 steps (50%), return 22.8, 1,000 steps/s, 0:05 left",
        "together: 10,000 of 10,000 steps (100%), return 22.8, 1,000 steps/s, done in 0:10",
        "  selector: calls of 5.2 steps",
        "  left: 25% of steps, reward 0.031 a step",
        "  inner/right: 75% of steps, reward -1.5 a step",
        "  idle: 0% of steps",
    ]


@pytest.mark.parametrize("on_terminal", [False, True])
def test_quiet(clock, terminal, monkeypatch, capsys, on_terminal):
    monkeypatch.setattr(terminal, "isatty", lambda: on_terminal)
    with redirect_stderr(terminal), Progress(quiet=True) as progress:
        progress.message("hello")
        train(progress, clock)
        progress.done("selector", 5, 1.0, {})
    assert terminal.getvalue() == ""
    assert capsys.readouterr().out == ""


def screen(terminal: Terminal) -> list[str]:
    """The lines written, in order, without the codes for colours and the cursor, and wide gaps."""
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue())
    return [" ".join(line.split()) for line in re.split(r"[\r\n]+", text) if line.strip()]


BAR = "━+[╸╺]?━*"


def test_bars_keep_finished_stages(clock, terminal, capsys):
    with redirect_stderr(terminal), Progress() as progress:
        progress.message("run: runs/[7]")
        train(progress, clock)
        progress.stage("selector", 2_000_000)
        clock.now += 1
        progress.tick("selector", 500_000, 50.0, {"return": 12.0})
    lines = screen(terminal)
    assert lines[0] == "run: runs/[7]"
    assert re.fullmatch(r"landing ━+ 20k/20k return 200.0 1,000 steps/s done in 0:20", lines[-2])
    assert re.fullmatch(f"selector {BAR} 500k/2M return 12.0 10,000 steps/s 2:30 left", lines[-1])
    assert capsys.readouterr().out == ""


def test_everyone_who_learns_in_a_stage_has_a_bar_of_how_much_it_acts(clock, terminal):
    with redirect_stderr(terminal), Progress() as progress:
        progress.stage("together", 10_000)
        for i in range(1, 4):
            clock.now += 1
            progress.tick("together", 1_000 * i, 1.0 * i, TOGETHER | {"left.usage": i / 10})
        progress.done("together", 10_000, 5.0, TOGETHER)
    wanted = [
        f"together {BAR} 10k/10k return 22.8 2,000 steps/s done in 0:05",
        f"selector {BAR} calls of 5.2 steps",
        f"left {BAR} 25% of steps reward 0.031 a step",
        f"inner/right {BAR} 75% of steps reward -1.5 a step",
        f"idle {BAR} 0% of steps",
    ]
    assert re.fullmatch("\n".join(wanted), "\n".join(screen(terminal)[-5:]))


def test_bars_are_drawn_a_few_times_a_second(clock, terminal):
    with redirect_stderr(terminal), Progress() as progress:
        train(progress, clock, every=0.01)  # 2,000 updates in 20 s
    assert 40 <= sum(line.startswith("landing") for line in screen(terminal)) <= 110


@pytest.mark.parametrize(("name", "value"), [("NO_COLOR", "1"), ("CI", "true"), ("TERM", "dumb")])
def test_no_bars_where_they_are_unwanted(clock, terminal, monkeypatch, name, value):
    monkeypatch.setenv(name, value)
    with redirect_stderr(terminal), Progress() as progress:
        train(progress, clock)
    assert "\x1b" not in terminal.getvalue()
    assert len(terminal.getvalue().splitlines()) == 5


def test_the_display_ends_with_an_error(clock, terminal):
    progress = Progress()

    def interrupted() -> None:
        with progress:
            progress.stage("landing", 10)
            raise KeyboardInterrupt

    with redirect_stderr(terminal):
        with pytest.raises(KeyboardInterrupt):
            interrupted()
        assert terminal.getvalue().endswith("\x1b[?25h")  # the cursor is visible again
        progress.message("stopped")
    assert terminal.getvalue().endswith("stopped\n")


def test_rich_is_imported_only_to_draw():
    code = (
        "import runpy, sys; m = runpy.run_path(sys.argv[1])\n"
        "with m['Progress']() as p: p.message('hello')\n"
        "assert 'rich' not in sys.modules"
    )
    command = [sys.executable, "-c", code, str(Path(str(module.__file__)))]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "hello\n")


STAGES = [
    stage_entry("left", budget=20_000, steps=10_000, seconds=5.0),
    stage_entry("right", "waiting", budget=20_000),
    stage_entry("selector", "waiting", budget=40_000),
]


def later_stages(progress: Progress, clock: Clock) -> None:
    """A run goes on whose first stage reached its target early; later ones are slower."""
    progress.plan(STAGES)
    progress.stage("right", 20_000)
    clock.now += 10
    progress.tick("right", 10_000, 10.0, {})
    clock.now += 10
    progress.done("right", 20_000, 20.0, {})
    progress.stage("selector", 40_000)
    clock.now += 40
    progress.tick("selector", 20_000, 40.0, {})
    progress.done("selector", 40_000, 80.0, {})


def test_of_several_stages_it_tells_which_one_it_is_and_the_time_left_in_all(clock, capsys):
    with Progress() as progress:
        later_stages(progress, clock)
    # After 10 s of the second: 10 s at its speed, and 40,000 steps at 20,000 in 15 s.
    assert capsys.readouterr().err.splitlines() == [
        "right (2 of 3): training for 20,000 steps",
        "right (2 of 3): 10,000 of 20,000 steps (50%), 1,000 steps/s, 0:10 left, 0:40 left in all",
        "right (2 of 3): 20,000 of 20,000 steps (100%), 1,000 steps/s, done in 0:20, "
        "0:33 left in all",
        "selector (3 of 3): training for 40,000 steps",
        "selector (3 of 3): 20,000 of 40,000 steps (50%), 500 steps/s, 0:40 left, 0:40 left in all",
        "selector (3 of 3): 40,000 of 40,000 steps (100%), 500 steps/s, done in 1:20",
    ]


def test_of_several_stages_the_first_bar_is_of_all(clock, terminal):
    with redirect_stderr(terminal), Progress() as progress:
        later_stages(progress, clock)
    lines = screen(terminal)
    total = [line for line in lines if line.startswith("in all")]
    for told in ("20k/80k stage 2 of 3 0:40 left", "70k/80k stage 3 of 3 done in 1:45"):
        assert any(re.fullmatch(f"in all {BAR} {told}", line) for line in total), total
    assert lines.index(total[-1]) < len(lines) - 2, "it stands above the stages"


def test_a_long_run_without_a_terminal_writes_few_lines(clock, capsys):
    with Progress() as progress:
        progress.stage("landing", 10_000_000)
        for i in range(1, 36_000):  # an hour
            clock.now += 0.1
            progress.tick("landing", 100 * i, 0.1 * i, {})
    lines = capsys.readouterr().err.splitlines()
    assert 15 < len(lines) < 40


def test_messages_go_to_the_logger_too_also_where_it_is_quiet(caplog, capsys):
    caplog.set_level("INFO", logger="skillweave")
    with Progress(quiet=True) as progress:
        progress.message("left: target reached")
    assert [(r.name, r.levelname, r.message) for r in caplog.records] == [
        ("skillweave", "INFO", "left: target reached")
    ]
    assert capsys.readouterr().err == ""


def played(over: int, of: int = 4) -> SimpleNamespace:
    one = np.ones(of, int)
    return SimpleNamespace(over=np.arange(of) < over, episode=np.arange(of), lasted=one)


def test_an_evaluation_shows_its_episodes_after_a_second_and_then_goes_away(clock, terminal):
    with redirect_stderr(terminal), EpisodeProgress(20) as progress:
        for _ in range(9):
            clock.now += 0.1
            progress.watch(played(0))
        assert terminal.getvalue() == ""
        clock.now += 1.1
        progress.watch(played(4))
        clock.now += 2.0
        progress.watch(played(4))
    for told in ("4 of 20 episodes 40 steps 0:08 left", "8 of 20 episodes 44 steps 0:06 left"):
        assert any(re.fullmatch(rf"evaluation \S+ {told}", line) for line in screen(terminal))
    assert "\x1b[2K" in terminal.getvalue().rpartition("8 of 20")[2], "the line is erased"


def test_episodes_are_not_shown_without_a_terminal_where_quiet_or_under_another_display(
    clock, terminal, capsys
):
    def evaluate(progress: EpisodeProgress) -> None:
        with progress:
            clock.now += 5
            progress.watch(played(4))

    evaluate(EpisodeProgress(20))
    with redirect_stderr(terminal):
        evaluate(EpisodeProgress(20, quiet=True))
        assert terminal.getvalue() == ""
        with Progress() as training:
            training.stage("landing", 10)
            evaluate(EpisodeProgress(20))
    assert "evaluation" not in terminal.getvalue()
    assert capsys.readouterr().err == ""


@pytest.mark.slow
def test_a_report_shows_the_episodes_that_it_plays_and_films(terminal, tmp_path, monkeypatch):
    pytest.importorskip("vl_convert")
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr(module, "PATIENCE", 0.0)
    monkeypatch.setattr("skillweave.reporting.displays.Bars.every", 0.0)
    run = declare().train(tmp_path / "run", quiet=True)
    with redirect_stderr(terminal):
        run.report(episodes=4, films=2, quiet=True)
        assert terminal.getvalue() == ""
        run.report(episodes=4, films=2)
    for told in (r"report \S+ \d of 4 episodes", r"film \S+ 2 of 2 episodes 18 steps"):
        assert any(re.match(told, line) for line in screen(terminal))
