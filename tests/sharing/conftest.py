"""A hub on this machine, and a run to push to it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator

import pytest
from hub_server import Hub, go_to, serve
from shared_runs import Left, Right, declare

import skillweave as sw


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> sw.Run:
    """A run with an evaluation and a film."""
    path = tmp_path_factory.mktemp("trained") / "run"
    run = declare(Left(), Right()).train(path, quiet=True)
    run.evaluate(episodes=4, save=True)
    (path / "hierarchy.gif").write_bytes(b"GIF89a, as far as the hub knows")
    return run


@pytest.fixture
def run(trained, tmp_path) -> sw.Run:
    """A copy of it, which a test may change; without curves, which take long to draw."""
    shutil.copytree(trained.path, tmp_path / "run")
    (tmp_path / "run/metrics.jsonl").unlink()
    return sw.Run(trained.declaration, tmp_path / "run", trained.policy)


@pytest.fixture
def hub(tmp_path, monkeypatch) -> Iterator[Hub]:
    with serve() as found:
        go_to(found.url, tmp_path / "cache", monkeypatch)
        yield found
