"""Skills with parts, and corrections, act in an export as they act here."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from crane import Arm, Crane, Hook, crane
from torch import nn

import skillweave as sw
from skillweave.export.runner import Runner
from skillweave.skills.mapping import Part

pytest.importorskip("onnxscript")
GREEDY = sw.Selection(greedy_skills=True, greedy_selector=True)


def compare(policy: Any, folder: Any, code: Any, kind: str = "box", masked: bool = False) -> None:
    """Let a player, the runner, and the policy that is read back act in two episodes."""
    again = sw.Player(sw.load_policy(folder, code=code))
    player, runner, env = sw.Player(policy), Runner(folder, code), Crane(kind, masked)
    actions = []
    for seed in range(2):
        obs, info = env.reset(seed=seed)
        player.reset(), runner.reset(), again.reset()
        ended = False
        while not ended:
            action = player.act(obs, info=info)
            np.testing.assert_allclose(runner.act(obs, info=info), action, atol=1e-5)
            np.testing.assert_allclose(again.act(obs, info=info), action, atol=1e-5)
            obs, _, _, ended, info = env.step(action)
            actions.append(np.ravel(action))
    assert len(np.unique(np.round(actions, 4), axis=0)) > 3


def in_turn(obs: Any) -> Any:
    return np.array(["arm", "hook"])[obs["camera"][:, 0, 0, 0] // 4 % 2]


def half(hook: Any) -> Any:
    return 0.5 * hook["hook"]


def skills(sees: Any) -> Any:
    return [Arm(), type("Hook", (Hook,), {"sees": sees})()]


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize(
    "sees",
    [
        ("hook", "mode"),
        {"picture": "camera", "numbers": (Part("hook", scale=2.0), "arm")},
        ("arm", half),
        "camera",
    ],
    ids=["numbers", "inputs", "function", "image"],
)
@pytest.mark.parametrize("rest", ["hold", (0.0, 0.5, "hold")])
def test_learnt_skills_with_parts(sees, rest, tmp_path):
    run = crane(skills(sees), selector=in_turn, rest=rest, steps=130, selection=GREEDY).train(
        quiet=True
    )
    export = run.export(tmp_path / "out")
    compare(run.policy, tmp_path / "out", export.functions)


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("kind", ["several", "bits", "one"])
def test_choices_with_parts(kind, tmp_path):
    def declared() -> Any:
        if kind != "one":
            return skills(("hook", "mode"))
        acts = {"arm": (0, 2), "hook": (3, 1)}
        return [type(n, (k,), {"name": n, "acts": acts[n]})() for n, k in ONES.items()]

    rest = {} if kind == "one" else {"rest": "hold"}
    env = sw.EnvSpec(lambda: Crane(kind), engine="sync", workers=1)
    how = {"selector": in_turn, "steps": 130, "selection": GREEDY}
    run = crane(declared(), env=env, **how, **rest).train(quiet=True)
    ready = run.export(tmp_path / "out")
    compare_choices(run.policy, tmp_path / "out", ready.functions, kind)


ONES = {"arm": Arm, "hook": Hook}


def compare_choices(policy: Any, folder: Any, code: Any, kind: str) -> None:
    again = sw.Player(sw.load_policy(folder, code=code))
    player, runner, env = sw.Player(policy), Runner(folder, code), Crane(kind)
    obs, _ = env.reset(seed=0)
    for _ in range(20):
        action = player.act(obs)
        assert (runner.act(obs) == action).all()
        assert (again.act(obs) == action).all()
        obs, *_ = env.step(action)


def test_a_mask_is_cut_in_the_runner(tmp_path):
    class Some(sw.Skill):
        """Owns three choices of four."""

        acts = (0, 1, 3)

    env = sw.EnvSpec(lambda: Crane("one", True), engine="sync", workers=1)
    run = crane([Some()], env=env, steps=130, selection=GREEDY).train(quiet=True)
    export = run.export(tmp_path / "out")
    world, runner, player = Crane("one", True), Runner(tmp_path / "out", export.functions), None
    player = run.player()
    obs, info = world.reset(seed=0)
    for _ in range(10):
        action = runner.act(obs, info=info)
        assert action == player.act(obs, info=info)
        assert info["action_mask"][action]
        obs, *_, info = world.step(action)
    with pytest.raises(ValueError, match="allows none of the choices"):
        runner.act(obs, mask=[0, 0, 1, 0])


def middle(obs: Any) -> Any:
    return np.concatenate([-0.5 * obs["arm"], -0.25 * obs["hook"]], axis=1)


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("name", ["function", "every", "module"])
@pytest.mark.parametrize("acts", [None, (0, 2)])
def test_corrections(name, acts, tmp_path):
    torch.manual_seed(0)
    base = {
        "function": sw.from_function(middle),
        "every": sw.from_function(middle, every=3),
        "module": sw.from_torch(nn.Linear(3, 3), sees=("arm", "hook")),
    }[name]
    if acts is not None:
        ready = {"module": nn.Linear(3, 2)}.get(name)
        two = sw.from_function(lambda obs: middle(obs)[:, :2], every=3 if name == "every" else 1)
        base = two if ready is None else sw.from_torch(ready, sees=("arm", "hook"))
    skill = type("Better", (sw.Skill,), {"policy": sw.Residual(base, 0.5), "acts": acts})()
    rest = {} if acts is None else {"rest": (0.0, 0.25, 0.0)}
    run = crane([skill], steps=130, selection=GREEDY, **rest).train(quiet=True)
    export = run.export(tmp_path / "out")
    compare(run.policy, tmp_path / "out", export.functions)


def test_what_the_runner_does_not_follow_says_so(tmp_path):
    import gymnasium as gym

    class Sideways(Arm):
        goal_space = gym.spaces.Box(-1, 1, (2,), np.float32)

        def reward(self, step):
            return -np.abs(step.next_obs["arm"] - step.goal).sum(axis=1)

    run = crane([Sideways(), Hook()], steps=130).train(quiet=True)
    with pytest.raises(sw.PolicyError, match=r"skill 'sideways' has goals"):
        run.export(tmp_path / "goals")
    ready = crane(steps=130).train(quiet=True).policy
    skill = type("Better", (sw.Skill,), {"policy": sw.Residual(ready)})()
    run = crane([skill], steps=130).train(quiet=True)
    with pytest.raises(sw.PolicyError, match=r"'better' corrects a hierarchy \(Residual\)"):
        run.export(tmp_path / "hierarchy")
