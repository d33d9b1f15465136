"""Arguments that stand in several places: methods, their options as data, and the command line."""

import inspect
from dataclasses import MISSING, fields
from typing import get_type_hints

import pytest

import skillweave as sw
from skillweave.api.train_options import TrainOptions
from skillweave.cli.commands import ResumeCommand, TrainCommand
from skillweave.cli.elsewhere import OF_TRAIN
from skillweave.hierarchy.settings import USUAL_CALL_STEPS, Settings
from skillweave.planning import Planner
from skillweave.repair.repairing import RepairOptions
from skillweave.training.defaults import AGENT_DEFAULTS, HIERARCHY_DEFAULTS, TrainDefaults

OF_HIERARCHIES = {"log_calls", "log_calls_info", "flat"}
"""Arguments of ``Hierarchy.train`` that plain agents do not have."""


def arguments(function, *without):
    """By name, in order: the default and the annotation of a function's arguments."""
    parameters = inspect.signature(function).parameters.values()
    skipped = {"self", *without}
    return {p.name: (p.default, p.annotation) for p in parameters if p.name not in skipped}


def options(kind, *without):
    """The same of a dataclass."""
    defaults = {f.name: inspect.Parameter.empty if f.default is MISSING else f.default
                for f in fields(kind)}  # fmt: skip
    return {f.name: (defaults[f.name], f.type) for f in fields(kind) if f.name not in without}


# A list, or one word, of trackers: data has the list.
ONE_OR_MORE = {"track": "str | Sequence[str]"}


@pytest.mark.parametrize(
    ("method", "kind", "without"),
    [
        (sw.Hierarchy.train, TrainOptions, set()),
        (sw.Agent.train, TrainOptions, OF_HIERARCHIES),
        (sw.Run.repair, RepairOptions, set()),
    ],
)
def test_a_method_and_its_options_have_the_same_arguments(method, kind, without):
    found, wanted = arguments(method), options(kind, *without)
    assert list(found) == list(wanted)
    for name, (default, annotation) in wanted.items():
        assert found[name] == (default, ONE_OR_MORE.get(name, annotation))


def test_train_agent_takes_an_agents_settings_and_the_arguments_of_its_training():
    found = arguments(sw.train_agent)
    trained = arguments(sw.Agent.train)
    assert {name: found[name] for name in trained} == trained
    settings = [f.name for f in fields(sw.Agent) if f.name != "train_defaults"]
    assert [name for name in found if name not in trained] == settings


def test_resume_takes_what_belongs_to_a_process_and_a_plan_the_settings_of_the_planner():
    names = ["run_dir", "quiet", "callback", "evolve", "cluster"]
    assert list(arguments(sw.Hierarchy.resume)) == names
    wanted = options(TrainOptions)
    for name in names[1:]:
        assert arguments(sw.Agent.resume)[name] == wanted[name]
    planner = arguments(Planner, "log", "task", "skills")
    assert {k: v for k, v in arguments(sw.Run.plan).items() if k in planner} == planner


def described(function):
    """The arguments under "Args:" in a docstring, in order."""
    text = inspect.getdoc(function).partition("Args:\n")[2]
    lines = text.partition("\n\n")[0].splitlines()
    return [line.partition(":")[0].strip(" *") for line in lines if line[4:5].strip()]


@pytest.mark.parametrize(
    "function",
    [
        sw.Hierarchy.train, sw.Agent.train, sw.Hierarchy.resume, sw.train_agent, sw.Run.repair,
        sw.Run.evaluate, sw.Run.render, sw.Run.report, sw.Run.player, sw.Run.log_calls, sw.Run.plan,
    ],
)  # fmt: skip
def test_a_docstring_describes_each_argument_in_its_place(function):
    assert described(function) == list(arguments(function))
    first = inspect.getsource(function)
    assert all(f"{name}:" in first for name in arguments(function))


def test_agents_and_hierarchies_describe_the_same_argument_alike():
    def texts(function):
        text = inspect.getdoc(function).partition("Args:\n")[2].partition("\n\n")[0]
        found, name = {}, ""
        for line in text.splitlines():
            if line[4:5].strip():
                name = line.partition(":")[0].strip()
            found[name] = f"{found.get(name, '')} {line.strip()}".strip()
        return found

    hierarchy, agent, function = map(texts, (sw.Hierarchy.train, sw.Agent.train, sw.train_agent))
    assert agent == {k: v for k, v in hierarchy.items() if k not in OF_HIERARCHIES}
    assert agent == {k: v for k, v in function.items() if k in agent}


@pytest.mark.parametrize("command", [TrainCommand, ResumeCommand])
def test_a_command_has_the_defaults_of_the_method(command):
    method = sw.Hierarchy.train if command is TrainCommand else sw.Hierarchy.resume
    wanted = arguments(method)
    shared = {f.name: f for f in fields(command) if f.name in wanted}
    assert {"quiet"} <= set(shared)
    for name, field in shared.items():
        empty = wanted[name][0] in (None, ()) and field.default in (None, ())
        assert empty or field.default == wanted[name][0], name


def test_one_body_has_every_setting_of_a_hierarchy():
    body = inspect.getsource(sw.Hierarchy)
    assert all(f"\n    {f.name}: {f.type}" in body for f in fields(sw.Hierarchy))
    hints = get_type_hints(sw.Hierarchy, include_extras=True)
    levels = get_type_hints(Settings, include_extras=True)
    assert {name: hints[name] for name in levels} == levels
    assert list(levels) == [f.name for f in fields(sw.Hierarchy) if f.name in levels]
    assert sw.Hierarchy.call_steps == USUAL_CALL_STEPS


def test_defaults_of_training_are_arguments_of_train():
    names = [f.name for f in fields(TrainDefaults) if f.name != "flat"]
    assert names == list(HIERARCHY_DEFAULTS)
    assert [name for name in arguments(sw.Hierarchy.train) if name in names] == names
    assert OF_TRAIN == AGENT_DEFAULTS
    assert set(AGENT_DEFAULTS) == set(arguments(sw.Agent.train)) & set(names)
