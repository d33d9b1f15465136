"""What numbers are divided by: constants, sentinels, and numbers far beyond what was seen."""

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

import skillweave
from skillweave._internal.notices import collected_notices
from skillweave._internal.seeding import Seeds
from skillweave.algorithms import config
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.algorithms.registry import make_algorithm
from skillweave.calls.neighbors import FeatureMap, Standard
from skillweave.ops.moments import explained_variance, merge_moments, normalize, scale_of

ROOT = Path(skillweave.__file__).parent
DEVIATION = re.compile(r"\b(nan)?(std|var|var_mean|std_mean)\(|var\b.*sqrt\(|sqrt\(.*(\b|_)var\b")
MAY_DEVIATE = {
    "ops/moments.py",  # the rule
    "calls/neighbors.py",  # Standard, by the same rule
    "training/evaluation.py",  # a confidence interval
    "training/episodes.py",  # a standard error
    "robots/inputs.py",  # beside deviations of the training: nothing is divided by it
}
BOX = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)


def test_deviations_are_computed_where_the_rule_for_constants_stands():
    files = {path.relative_to(ROOT).as_posix(): path.read_text() for path in ROOT.rglob("*.py")}
    found = {name for name, text in files.items() if DEVIATION.search(text)}
    assert found == MAY_DEVIATE, "use scale_of or Standard"


@pytest.mark.parametrize("masked", [True, False])
@pytest.mark.parametrize("value", [0.0, 0.1, -1000.1, 1e6])
def test_a_constant_is_seen_as_one_however_large(value, masked):
    mean, var, count = torch.zeros(1, 1), torch.ones(1, 1), torch.zeros(1)
    for rows in (1, 3, 1000, 30_000):
        valid = torch.rand(1, rows) < 0.3 if masked else None
        mean, var, count = merge_moments(mean, var, count, torch.full((1, rows, 1), value), valid)
    assert scale_of(mean, var).item() == 1.0
    same = torch.full((1, 999), value)
    assert normalize(same).abs().max() <= 1e-6 * max(1.0, abs(value))
    assert explained_variance(same + 1.0, same).item() == 0.0


def learnt(name, batch):
    action_space = gym.spaces.Discrete(3) if name in {"DQN", "CQL", "SkillCritic"} else BOX
    settings = getattr(config, name)(normalize_obs=True)
    algorithm = make_algorithm(settings, BOX, action_space)
    state = algorithm.init([Seeds(0)])
    algorithm.update_obs_stats(state, torch.from_numpy(batch)[None])
    algorithm.update_return_stats(state, torch.full((1, len(batch)), 7.0))
    return algorithm, state


@pytest.mark.parametrize("name", config.BUILT_IN)
def test_what_was_constant_while_it_learnt_does_not_rule_what_networks_see(name):
    batch = np.full((500, 2), 3.0, np.float32)
    batch[:, 1] = np.arange(500) % 2 * 2e-3  # small units are scaled as ever
    algorithm, state = learnt(name, batch)
    seen = algorithm.inputs(algorithm.acting_params(state), torch.tensor([[[3.01, 2e-3]]]))
    assert seen["vector"].flatten().tolist() == pytest.approx([0.01, 0.995], abs=1e-3)
    assert state.return_scale.item() == 1.0


@pytest.mark.parametrize(("share", "noise", "digits"), [(0.05, 0, 9), (0.3, 0, 0), (0.05, 1e5, 9)])
def test_a_sentinel_does_not_make_the_planner_blind(share, noise, digits):
    rng = np.random.default_rng(0)
    values = rng.uniform(-3, 3, (4000, 1)).round(digits)
    flag = rng.random((4000, 1)) < 0.003
    far = -999.0 + noise * rng.normal(size=values.shape)
    mixed = np.where(rng.random(values.shape) < share, far, values)
    scale = Standard(np.concatenate([mixed, flag, far * 0.0], 1)).scale
    assert scale == pytest.approx([1 / values.std(), 1 / flag.std(), 0.0], rel=0.1)


CASES = {  # what was seen, what comes later, and whether it is named
    "a constant that changes": ([0.0] * 1_000, 1.0, False),
    "a constant that is far away": ([0.0] * 1_000, 50.0, True),
    "a rare flag": ([0.0] * 9_999 + [1.0], 1.0, False),
    "a sentinel": ([-1.0, 1.0] * 500, -999.0, True),
    "a little outside": ([-1.0] + [0.0] * 1_000 + [1.0], 5.0, False),
    "a short training": ([-1.0, 1.0] * 50, -999.0, False),
    "a sentinel that was seen": ([-1.0, 1.0] * 500 + [-999.0], -999.0, False),
}


@pytest.mark.parametrize("who", ["policy", "plan"])
@pytest.mark.parametrize("case", CASES)
def test_a_number_far_beyond_what_was_seen_is_named_once(case, who):
    seen, later, named = CASES[case]
    rows = np.stack([np.arange(len(seen)) % 2, seen], 1).astype(np.float32)
    now = np.array([[0, later]], np.float32)
    if who == "plan":
        features = FeatureMap(BOX, None, rows, "skill 'go'")
        acts = [lambda: features.acting(now)] * 2
    else:
        algorithm, state = learnt("PPO", rows)
        policy = AgentPolicy.from_file(*AgentPolicy.of(algorithm, state).to_file(), "runs/go")
        acts = [lambda: policy.act({}, now)] * 2
    with collected_notices() as notices:
        for act in acts:
            act()
    assert [f"1 is {later:g}" in text for text in notices.take()] == [True] * named


def test_statistics_of_sb3_have_the_same_scale():
    from stable_baselines3.common.running_mean_std import RunningMeanStd

    from skillweave.skills.sb3 import _variance

    rms = RunningMeanStd(shape=(2,))
    rms.update(np.stack([np.full(640, 5.0), np.arange(640)], 1))
    assert _variance(rms).tolist() == [1.0, rms.var[1]]
