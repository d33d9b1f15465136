"""Wrong names of arguments: every public name refuses them. ``test_mistakes.py`` has messages."""

from __future__ import annotations

import copy
import dataclasses
import inspect
import pickle
from importlib import import_module

import pytest
from installed import HOMES

import skillweave as sw
from skillweave._internal.arguments import checked_names
from skillweave.errors import DeclarationError


def test_a_type_error_of_the_body_is_not_hidden():
    @checked_names
    def fails(value: int) -> int:
        return len(value)  # type: ignore[arg-type]

    with pytest.raises(TypeError, match="has no len"):
        fails(5)


def test_a_subclass_of_a_user_may_have_attributes_of_its_own():
    class Stay(sw.Skill):
        """Does anything."""

    class Mine(sw.Hierarchy):
        recipe = "theirs"

        def __init__(self) -> None:
            super().__init__("CartPole-v1", [Stay()])
            self.notes = self.recipe = "mine"

    assert (Mine().notes, Mine().recipe) == ("mine", "mine")
    with pytest.raises(DeclarationError, match="is 'skills' meant"):
        Mine().skils = []


@pytest.mark.parametrize("config", [sw.PPO(gamma=0.5), sw.SAC(), sw.Network((8,)), sw.EnvSpec("a")])
def test_settings_are_copied_and_described_as_before(config):
    kind = type(config)
    assert pickle.loads(pickle.dumps(config)) == config
    assert copy.deepcopy(config) == config == dataclasses.replace(config)
    names = list(inspect.signature(kind).parameters)
    assert names == [f.name for f in dataclasses.fields(kind) if f.init]


# Mathematics, types of results, what only authors of algorithms call, and `fetch`: `--help` would
# import NumPy for it.
INSIDE = {
    "ActingParams", "ActionHead", "AgentState", "Algorithm", "Array", "Encoder", "Evaluation",
    "Export", "LastCall", "Layout", "Net", "OptionsEnv", "ParameterGroup",
    "ParentSelection", "Policy", "Report",
    "Between", "Blame", "CallEnds", "CallLog", "Chain", "ChainChance", "Effect", "Entry",
    "Forecast", "InputPart", "InputSheet", "OutputLimits",
    "Handover", "HandoverTable", "MeasuredHandovers", "Pair", "PlannedRun", "ReadMapping",
    "Remedies", "Reported", "Segments", "Tried",
    "Rollout", "Run", "Sample", "Seeds", "Skill", "SkillweaveError", "Step", "adam_",
    "clip_grad_norm_", "fetch", "gae", "mask_logits", "masked_mean", "normalize", "tree",
    *HOMES["skillweave.errors"],
}  # fmt: skip
CALLED = [(m, name) for m, homes in HOMES.items() for name in homes if name not in INSIDE]


@pytest.mark.parametrize(("module", "name"), CALLED)
def test_every_public_name_refuses_an_unknown_argument(module, name):
    with pytest.raises(DeclarationError, match=r"no (setting|argument) 'quxx'|needs "):
        getattr(import_module(module), name)(quxx=1)


@pytest.mark.parametrize("name", [n for n in vars(sw.Run) if not n.startswith("_")])
def test_every_method_of_a_run_refuses_an_unknown_argument(name):
    method = vars(sw.Run)[name]
    if isinstance(method, property):
        return
    with pytest.raises(DeclarationError, match=r"no argument 'quxx'|needs "):
        method(object(), quxx=1)
