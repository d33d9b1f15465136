"""The tool that says where a step's time goes."""

import itertools
import threading
from types import SimpleNamespace

import pytest

import skillweave as sw
from benchmarks import where


def test_a_part_is_counted_without_the_parts_within_it(monkeypatch):
    clock, seconds = where.Clock(), itertools.count()
    ticking = SimpleNamespace(perf_counter=lambda: next(seconds), thread_time=lambda: 0.0)
    monkeypatch.setattr(where, "time", ticking)
    with clock.part("outer"):  # from 0 to 5
        with clock.part("inner"):  # from 1 to 2
            pass
        clock.timed(lambda: None, "inner")()  # from 3 to 4
    name = threading.current_thread().name
    assert clock.spent == {(name, "outer"): [3.0, 0.0], (name, "inner"): [2.0, 0.0]}


@pytest.mark.parametrize(
    "algorithm",
    [sw.PPO(n_steps=16, num_envs=4, batch_size=32), sw.SAC(learning_starts=64, num_envs=4)],
    ids=["threads", "one thread"],
)
def test_the_parts_of_a_training_make_up_its_time(algorithm):
    env = sw.EnvSpec("CartPole-v1", engine="sync", workers=1)

    def train(steps: int) -> None:
        sw.train_agent(env, algorithm, steps, quiet=True)

    found = where.measure(train, 512)
    rows = found["rows"]
    learning = {row["part"] for row in rows if (row["thread"] == "learner") == algorithm.overlap}
    assert {"forward, targets", "backward", "optimiser"} <= learning
    assert {"environments", "acting: network"} <= {row["part"] for row in rows}
    whole = 1e6 / found["steps_per_second"]
    collecting = sum(row["clock"] for row in rows if row["thread"] != "learner")
    assert collecting == pytest.approx(whole, rel=0.05)
    assert all(row["clock"] >= 0.0 for row in rows)


def test_what_is_measured_is_as_before_afterwards():
    methods = [getattr(owner, name) for parts in where.PARTS.values() for owner, name in parts]
    with where.watched(where.Clock(), 0):
        pass
    again = [getattr(owner, name) for parts in where.PARTS.values() for owner, name in parts]
    assert methods == again
