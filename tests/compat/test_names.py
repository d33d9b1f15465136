"""Every name that the tutorial takes from the library is there, with the signature it had."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from pathlib import Path

import pytest
from compat.tutorial_scripts import SHIM, TEXT, moved, scripts

ROOT = Path(__file__).parents[2]
SEED = ROOT.parent / "shared/seed/000_99d5b8c7da342b8f.txt"
SIBLINGS = {
    "algorithms.dqn": "DQN",
    "algorithms.dqn_rainbow": "RainbowDQN",
    "algorithms.ddpg": "DDPG",
    "algorithms.td3": "TD3",
    "training.train_off_policy": "train_off_policy",
    "components.replay_buffer": "ReplayBuffer",
    "hpo.tournament": "TournamentSelection",
    "hpo.mutation": "Mutations",
}
TODAY = {
    "makeVectEnvs": "make_vect_envs",
    "makeSkillVectEnvs": "make_skill_vect_envs",
    "initialPopulation": "create_population",
    "getAction": "get_action",
    "saveCheckpoint": "save_checkpoint",
    "loadCheckpoint": "load_checkpoint",
}


def imported(script: str) -> list[tuple[str, str]]:
    """Modules below the import root, and names from them."""
    return [
        (node.module.removeprefix(SHIM + "."), alias.name)
        for node in ast.walk(ast.parse(script))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(SHIM)
        for alias in node.names
    ]


def signatures() -> dict[tuple[str, str], str]:
    text = (Path(__file__).with_name("signatures.txt")).read_text().split("\n\n", 1)[1]
    lines = re.sub(r"\n {4}", " ", text).splitlines()
    found = [re.fullmatch(r"(\S+) (\S+): ?(.*)", line) for line in lines]
    return {(m[1], m[2]): m[3] for m in found if m}


def test_every_name_that_the_scripts_import_resolves():
    names = {name for script in scripts().values() for name in imported(moved(script))}
    assert len(names) == 6
    for module, name in names | set(SIBLINGS.items()):
        assert hasattr(importlib.import_module(f"{SHIM}.{module}"), name), (module, name)


def test_the_text_beside_the_repository_has_the_same_scripts_and_no_other_names():
    if not SEED.exists():
        pytest.skip("the text lies outside of the repository")
    text = SEED.read_text()
    assert TEXT.read_text().split("\n\n", 1)[1] in text
    lines = set(re.findall(r"^from (agilerl\S*) import (.+)$", text, flags=re.M))
    for module, names in lines:
        there = importlib.import_module(module.replace("agilerl", SHIM, 1))
        assert all(hasattr(there, name.strip()) for name in names.split(","))
    assert len(lines) == 4


def test_every_attribute_that_the_scripts_use_of_an_agent_is_there():
    from skillweave.compat.agilerl.algorithms.ppo import PPO

    agent = PPO([8], 4, False, True)
    tree = ast.parse("\n".join(scripts().values()))
    used = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and re.fullmatch(r"agent|\w+_agent|\w*pop\[0\]|PPO", ast.unparse(node.value))
    }
    assert used >= {"getAction", "learn", "scores", "steps", "saveCheckpoint", "load"}
    assert [name for name in used if not hasattr(agent, name)] == []


@pytest.mark.parametrize(("where", "asked"), signatures().items(), ids=lambda x: str(x)[:40])
def test_signatures_are_those_of_the_old_version(where, asked):
    module, path = where
    found = importlib.import_module(f"{SHIM}.{module}")
    for name in path.split("."):
        found = getattr(found, name)
    parameters = [p for p in inspect.signature(found).parameters.values() if p.name != "self"]
    parameters = [p for p in parameters if p.kind != p.VAR_KEYWORD]
    wanted = list(ast.parse(f"def f({asked}): pass").body[0].args.args)
    defaults = [
        ast.literal_eval(d) for d in ast.parse(f"def f({asked}): pass").body[0].args.defaults
    ]
    assert [p.name for p in parameters][: len(wanted)] == [a.arg for a in wanted]
    own = [p.default for p in parameters if p.default is not p.empty]
    assert own == defaults
    assert len(parameters) == len(wanted)


def test_both_spellings_mean_the_same():
    from skillweave.compat.agilerl.algorithms import ddpg, dqn, dqn_rainbow, ppo, td3
    from skillweave.compat.agilerl.utils import utils

    kinds = (ppo.PPO, dqn.DQN, dqn_rainbow.RainbowDQN, ddpg.DDPG, td3.TD3)
    for old, today in TODAY.items():
        for place in kinds if old in dir(kinds[0]) else (utils,):
            assert getattr(place, old) is getattr(place, today)
