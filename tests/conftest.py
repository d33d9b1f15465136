"""One torch thread, the same examples of hypothesis in each run, shapes checked."""

import contextlib
import gc
import importlib.util
import os
import re
import signal
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # here, in each worker, and in what tests start

import pytest
import torch
from hypothesis import settings
from installed import EXTENSIONS

torch.set_num_threads(1)
os.fsync = lambda _: None  # no test cuts the power, so nothing need reach the disk
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell that runs the tests in the background has Ctrl-C ignored by all that it starts.
    signal.signal(signal.SIGINT, signal.default_int_handler)
settings.register_profile("skillweave", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("skillweave")

if importlib.util.find_spec("jaxtyping") and importlib.util.find_spec("beartype"):
    from shape_checks import check_shapes

    # Before anything else imports these: `from … import gae` then finds what is checked.
    check_shapes("returns", "losses", "distributions", "optim")


def is_missing(extension: str) -> bool:
    """Whether an extension is not installed, as where somebody works on the core alone."""
    return importlib.util.find_spec(f"skillweave.{extension}") is None


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Leave out the folder of tests of an extension that is not installed."""
    name = collection_path.name
    return True if name in EXTENSIONS and is_missing(name) else None


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[None]:
    """Leave out a file that imports an extension which is not installed."""
    report = yield
    found = re.search(r"(?:named 'skillweave\.|import name ')(\w+)", str(report.longrepr))
    if report.failed and found is not None and found[1] in filter(is_missing, EXTENSIONS):
        report.outcome = "skipped"
        report.longrepr = str(collector.path), 0, f"skillweave.{found[1]} is not there"
    return report


# Reasons of tests that would run if something were installed; others want a GPU or a small disk.
WANTING = re.compile(
    r"could not import|not installed|no browser|no EGL|no C\+\+ compiler", re.IGNORECASE
)


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what is slow, and skip what needs an extension that is not installed.

    Of a test with ``@pytest.mark.fast_cases(n)`` all cases but the first n are slow.
    """
    seen: Counter[str] = Counter()
    for item in items:
        for mark in item.iter_markers("needs"):
            if missing := [name for name in mark.args if is_missing(name)]:
                item.add_marker(pytest.mark.skip(reason=f"skillweave.{missing[0]} is not there"))
        limit = item.get_closest_marker("fast_cases")
        if limit is None:
            continue
        name = item.nodeid.split("[")[0]
        seen[name] += 1
        if seen[name] > limit.args[0]:
            item.add_marker("slow")


def pytest_collection_finish() -> None:
    """All tests are known: what they are made of is kept, and not searched for garbage any more.

    It is a great many objects, and was searched again and again as tests made their own.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail a run of CI in which a test was skipped for want of a package."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter is None or not os.environ.get("SKILLWEAVE_TESTS_NEED_ALL"):
        return
    skipped = [(report.nodeid, report.longrepr[2]) for report in reporter.stats.get("skipped", ())]
    missing = [f"{name}: {reason}" for name, reason in skipped if WANTING.search(reason)]
    if missing:
        print("\nskipped for want of something that can be installed:", *missing, sep="\n  ")
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture(scope="session", autouse=True)
def working_directory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A temporary working directory: trainings without a directory write to ``runs/`` there."""
    with contextlib.chdir(tmp_path_factory.mktemp("work")):
        yield


@pytest.fixture(scope="session", autouse=True)
def few_episodes() -> Iterator[None]:
    """Who learnt together is judged by few episodes: here it is of no matter who wins."""
    from skillweave.hierarchy import select_best

    assert (select_best.LEAST, select_best.MOST) == (20, 100), "so it is documented"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(select_best, "MOST", 4)
        patch.setattr(select_best, "SHORT_SHARE", 1e6)  # trainings are too short for any
        yield


@pytest.fixture(scope="session", autouse=True)
def short_forecasts() -> Iterator[None]:
    """A plan is forecast by a few episodes, each time that one is made."""
    if is_missing("planning"):
        yield
        return
    from skillweave.planning import forecast

    assert forecast.EPISODES == 200, "as usual_forecasts has it"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(forecast, "EPISODES", 20)
        yield


@pytest.fixture
def usual_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who learnt together is judged by as many episodes as users have."""
    from skillweave.hierarchy import select_best

    monkeypatch.setattr(select_best, "MOST", 100)
    monkeypatch.setattr(select_best, "LEAST", 100)


@pytest.fixture
def usual_forecasts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plans are forecast by as many episodes as for users."""
    monkeypatch.setattr("skillweave.planning.forecast.EPISODES", 200)


@pytest.fixture(autouse=True)
def forget_registered() -> Iterator[None]:
    """Algorithms that a test registers are forgotten after it."""
    from skillweave.algorithms import config

    known = dict(config._REGISTERED)
    yield
    config._REGISTERED.clear()
    config._REGISTERED.update(known)


@pytest.fixture
def unprobed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Call functions once, for the environments alone: for tests that record calls."""
    monkeypatch.setattr("skillweave.skills.outputs.look_at", lambda *_: None)


@pytest.fixture
def no_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    """Functions are called for what happens alone, not also to see whether they keep a state."""
    monkeypatch.setattr("skillweave.skills.outputs.look_at", lambda *_: None)
