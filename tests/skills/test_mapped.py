"""Policies from elsewhere act behind their mappings as their sources do, called by hand."""

from __future__ import annotations

import cloudpickle
import numpy as np
import pytest
from skills.mapped_models import CASES, Case, fit, observations, one


@pytest.fixture(scope="module")
def cases(tmp_path_factory) -> dict[str, Case]:
    pytest.importorskip("onnxruntime")
    pytest.importorskip("stable_baselines3")
    folder = tmp_path_factory.mktemp("mapped")
    return {name: make(folder) for name, make in CASES.items()}


@pytest.mark.parametrize("name", CASES)
def test_it_acts_as_its_source_wherever_others_act_or_start_again(cases, name):
    case, n = cases[name], 5
    policy, sources = fit(case.policy), [case.source() for _ in range(n)]
    sent = cloudpickle.loads(cloudpickle.dumps(policy))  # as to another process
    memory, rng, acted = policy.start(n), np.random.default_rng(1), set()
    for obs in observations(n, 30, seed=1):
        fresh = np.flatnonzero(rng.random(n) < 0.2)
        for k, v in policy.start(len(fresh)).items():
            memory[k][fresh] = v
        for i in fresh:
            sources[i] = case.source()
        rows = np.flatnonzero(rng.random(n) < 0.7)
        if not len(rows):
            continue
        before = {k: v.copy() for k, v in memory.items()}
        action, after = policy.act({k: v[rows] for k, v in memory.items()}, obs[rows])
        other, _ = sent.act({k: v[rows] for k, v in memory.items()}, obs[rows])
        np.testing.assert_array_equal(other, action)
        for k, v in memory.items():
            np.testing.assert_array_equal(v, before[k])  # a memory is not changed in place
            v[rows] = after[k]
        wanted = [sources[i].act(one(obs, i)) for i in rows]
        assert action.dtype == np.float32
        np.testing.assert_allclose(action, wanted, atol=1e-5)
        acted |= set(np.round(action, 3).reshape(-1).tolist())
    assert len(acted) > 3  # it does something
