"""The walk of ``docs/one-gradient.md`` is one that a reader can take."""

import pytest

from benchmarks import reading
from skillweave import SkillweaveError


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", reading.ROUNDS)
def test_every_function_on_the_walk_runs_and_they_are_soon_read(name):
    env, config = reading.ROUNDS[name]
    found = reading.on_the_walk(name, reading.watched(reading.one_round(env, config, 256)))
    assert len({reading.file_of(code) for code in found}) <= 15
    assert 400 < reading.lines_of(found) <= 1_500


def test_a_function_that_does_not_run_is_named():
    with pytest.raises(SkillweaveError, match=r"PPO: these did not run: .*PPOAlgorithm\.act in"):
        reading.on_the_walk("PPO", set())
