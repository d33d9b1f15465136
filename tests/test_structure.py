"""The rooms' import order, and the public names."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest
from installed import EXTENSIONS, HOMES

from skillweave._internal.public import ALSO

ROOT = Path(__file__).parents[1] / "skillweave"
MODULES = sorted(ROOT.rglob("*.py"))
PUBLIC_NAMES = [(module, name) for module, homes in HOMES.items() for name in homes]

# What a room may import; docs/architecture.md has a picture of it. `seeding` is open to all.
BASE = {
    "public",
    "errors",
    "policies",
    "policy_protocol",
    "rewards",
    "terminal",
    "tracebacks",
    "notebooks",
    "messages",
    "notices",
    "interrupts",
    "parent_process",
    "arguments",
    "named",
    "schema",
    "shapes",
    "paths",
    "prefixes",
    "extensions",
}
USED = {"algorithms", "envs", "errors", "evolution", "types"}  # users import from these, too
LEARNING = BASE | {"ops", "spaces", "skills", "networks", "envs", "buffers", "algorithms", "runs"}
LEARNING |= {"experience", "workers", "calls"}
CENTRE = LEARNING | {"training", "hierarchy", "evolution", "reporting", "export"}
CORE = CENTRE | {"shipped", "api", "cli", "skillweave"}
# The only imports of an extension by the core, for types alone: what methods of ``Run`` return, and
# a public name of the package.
RETURNED = {
    ("api", "data.segmenting"),
    ("api", "planning.planned_run"),
    ("api", "repair.repair_stage"),
    ("skillweave", "data.dataset"),
    ("skillweave", "data.recording"),
    ("skillweave", "robots.deploy_yaml"),
    ("skillweave", "robots.inputs"),
    ("skillweave", "robots.measuring"),
    ("skillweave", "robots.onnx_metadata"),
}
ROOMS: dict[str, set[str]] = {
    "public": {"extensions"},
    "seeding": set(),
    "policies": set(),
    "terminal": {"policies"},
    "tracebacks": set(),
    "notebooks": set(),
    "errors": {"policies", "tracebacks"},
    "policy_protocol": {"policies"},
    "rewards": {"policies"},
    "shapes": set(),
    "paths": set(),
    "prefixes": set(),
    "messages": {"errors", "tracebacks"},
    "notices": set(),
    "parent_process": set(),
    "arguments": {"errors", "messages", "policies"},
    "named": {"errors", "messages"},
    "schema": {"errors", "messages", "arguments", "policies"},
    "_internal": set(),
    "extensions": {"errors", "messages", "notices"},
    "interrupts": {"terminal"},
    "ops": BASE,
    "spaces": BASE,
    "skills": BASE | {"ops", "spaces"},
    "networks": BASE | {"ops", "spaces"},
    "toys": set(),
    "envs": BASE | {"spaces", "skills", "toys"},
    "buffers": BASE | {"ops", "spaces", "algorithms"},
    "algorithms": BASE | {"ops", "spaces", "networks"},
    "experience": BASE | {"spaces", "skills", "envs", "algorithms"},
    "workers": BASE | {"envs", "algorithms", "experience"},
    "runs": BASE | {"algorithms", "skills", "envs"},
    "calls": BASE | {"ops", "spaces", "skills", "envs", "algorithms", "experience", "runs"},
    "training": LEARNING,
    "hierarchy": LEARNING | {"training"},
    "evolution": LEARNING | {"training"},
    "export": LEARNING | {"training", "hierarchy"},
    "reporting": BASE
    | {"spaces", "skills", "envs", "runs", "experience", "calls", "training", "hierarchy"},
    "shipped": {"errors"},
    "api": CENTRE | {"shipped"},
    "types": {"public", "policies", "policy_protocol", "training", "hierarchy", "export"},
    "cli": CENTRE | {"shipped", "api", "skillweave"},
    "skillweave": CENTRE | {"api", "types"},  # the package itself: public names
    "__main__": {"cli"},
    **{name: CORE | below for name, below in EXTENSIONS.items()},
    "recipes": {"shipped", "skillweave", "api", *USED},  # as users write them
}
# Modules with a row of their own. Settings, which help and errors read, need no torch.
SETTINGS = {"errors", "policies.core", "messages", "schema", "named"}
LEAVES: dict[str, set[str]] = {
    "envs": {
        "public",
        "api.make_options",
        "envs.pool",
        "hierarchy.options_env",
    },  # public names of users alone
    "networks.config": SETTINGS,
    "schema": {"errors", "messages", "arguments", "policies.untrusted"},
    "algorithms.schedules": SETTINGS,
    "algorithms.config": SETTINGS
    | {"policies.untrusted", "networks.config", "algorithms.schedules"}
    | {"spaces.action_codec"},  # where it is called, as it needs torch
    "evolution.config": SETTINGS
    | {"policies.untrusted", "networks.config", "algorithms.config", "algorithms.schedules"},
}


def module_of(path: Path) -> str:
    """``algorithms.ppo`` for skillweave/algorithms/ppo.py; ``skillweave`` for the package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts[:-1] if parts[-1] == "__init__" else parts
    return name_of(".".join(parts)) or "skillweave"


def name_of(module: str) -> str:
    """A module's name in the rows here: those of ``_internal`` are rooms of their own."""
    return module.removeprefix("skillweave.").removeprefix("_internal.")


def room_of(module: str) -> str:
    """The room that a module stands in."""
    return module.split(".")[0]


NAMES = {module_of(p) for p in MODULES}


def imported(source: str, module: str, package: bool) -> Iterator[tuple[int, str]]:
    """Line and name of every module of the library that a source imports, wherever it does.

    Imports within functions and under TYPE_CHECKING count, and so do relative ones and
    ``import_module`` of a plain string.
    """
    here = ["skillweave", *(module.split(".") if module != "skillweave" else [])]
    for node in ast.walk(ast.parse(source)):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [a.name for a in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                stem = here[: len(here) - node.level + package]
                base = ".".join([*stem, *([node.module] if node.module else [])])
            deeper = [f"{base}.{a.name}" for a in node.names]
            # `from skillweave import recipes` imports a room, `… import PPO` the public names.
            names = [d if name_of(d) in NAMES else base for d in deeper]
        elif isinstance(node, ast.Call) and "import_module" in ast.dump(node.func):
            names = [a.value for a in node.args if isinstance(a, ast.Constant)]
        for name in names:
            if name == "skillweave" or name.startswith("skillweave."):
                yield node.lineno, name_of(name)


def violations(source: str, module: str, package: bool = False) -> list[str]:
    """The imports of a module that its room's row does not name."""
    room = room_of(module)
    found = []
    for line, name in imported(source, module, package):
        if (module, name) in RETURNED:
            allowed = True
        elif module in LEAVES:
            allowed = name == "seeding" or name in LEAVES[module]
        else:
            allowed = room_of(name) in ROOMS[room] | {room, "seeding"} - (
                {"skillweave"} if room == "skillweave" else set()
            )
        if not allowed:
            found.append(f"{module}, line {line}: imports {name}")
    return found


# The search itself


AGAINST = [
    ("envs.make", "from skillweave.training.stage import Stage"),
    ("envs.make", "import skillweave.runs.files as files"),
    ("envs.make", "def f():\n    from skillweave.algorithms.ppo import State"),
    ("envs.make", "if TYPE_CHECKING:\n    from skillweave.api import Run"),
    ("envs.make", "from ..experience import judge"),
    ("envs.make", "from skillweave import PPO"),
    ("envs.make", "from skillweave import recipes"),
    ("envs.make", "importlib.import_module('skillweave.runs')"),
    ("envs.make", "from skillweave.types import Array"),
    ("hierarchy.options_env", "from skillweave.types import Array"),
    ("networks.config", "from skillweave.networks.stacked import mlp"),
    ("seeding", "from skillweave.types import Step"),
    ("api.declared", "def f():\n    from skillweave import recipes"),
]
ALLOWED = [
    ("envs.make", "from skillweave.skills import Skill"),
    ("envs.make", "from .engine import Engine"),
    ("envs.make", "import numpy, gymnasium"),
    ("algorithms.config", "from skillweave.networks.config import Network"),
    ("recipes.x", "from skillweave import PPO, Hierarchy"),
    ("ops.returns", "from skillweave._internal.seeding import Seeds"),
]


def test_the_search_finds_imports_against_the_order_and_lets_pass_what_it_allows():
    for module, source in AGAINST:
        assert len(violations(source, module)) == 1, (module, source)
    for module, source in ALLOWED:
        assert violations(source, module) == [], (module, source)


# The order


def test_every_room_has_a_row_of_rooms_and_the_core_imports_no_extension():
    assert {room_of(module_of(p)) for p in MODULES} <= set(ROOMS)
    assert len(MODULES) > 30
    named = set().union(*ROOMS.values())
    assert named <= set(ROOMS)
    assert "__main__" not in named
    core = {room: row for room, row in ROOMS.items() if room not in EXTENSIONS}
    assert not set(EXTENSIONS) & set().union(*core.values())
    assert [room for room, row in core.items() if "cli" in row] == ["__main__"]


def test_the_order_has_no_circle():
    rooms = dict(ROOMS)
    while rooms:
        ready = [k for k, v in rooms.items() if not (v - {k}) & set(rooms)]
        assert ready, f"these import one another: {sorted(rooms)}"
        rooms = {k: v for k, v in rooms.items() if k not in ready}


def circles(graph: dict[str, set[str]]) -> set[str]:
    """Return the modules that import one another, directly or by others."""

    def reached(module: str) -> set[str]:
        seen, following = set[str](), [module]
        while following:
            for other in graph[following.pop()] - seen:
                seen.add(other)
                following.append(other)
        return seen

    return {module for module in graph if module in reached(module)}


def test_no_modules_import_one_another_also_for_types_alone():
    made = {"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}, "e": set[str]()}
    assert circles(made) == {"a", "b", "c"}
    graph: dict[str, set[str]] = {}
    for path in MODULES:
        module, package = module_of(path), path.name == "__init__.py"
        found = {name for _, name in imported(path.read_text(), module, package)}
        returned = {name for name in found if (module, name) in RETURNED}
        graph[module] = found & NAMES - {module} - returned
    assert circles(graph) == set()


def test_a_module_imports_only_what_its_row_names():
    found = [
        line
        for path in MODULES
        for line in violations(path.read_text(), module_of(path), path.name == "__init__.py")
    ]
    assert found == []


def test_settings_and_commands_need_neither_torch_nor_a_heavy_room():
    modules = [
        *(f"skillweave.{name}" for name in LEAVES),
        "skillweave",
        "skillweave._internal.seeding",
    ]
    modules += ["skillweave.types", "skillweave.cli.commands"]
    code = "import importlib, sys\n"
    code += "".join(f"importlib.import_module({name!r})\n" for name in modules)
    code += (
        "print(sorted({'torch', 'skillweave.api', 'skillweave.training.loop'} & set(sys.modules)))"
    )
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


# Public names


def lazy_exports(tree: ast.Module) -> list[ast.stmt]:
    """The imports that only type checkers see, where the module imports its names lazily."""
    blocks = [n for n in tree.body if isinstance(n, ast.If) and "lazy(__name__)" in ast.unparse(n)]
    return [statement for block in blocks for statement in block.body]


@pytest.mark.parametrize("module", HOMES)
def test_the_public_names_are_those_of_the_lazy_table_and_of_the_type_checker(module):
    package = ROOT.parent / module.replace(".", "/")
    file = package / "__init__.py" if package.is_dir() else package.with_suffix(".py")
    tree = ast.parse(file.read_text())
    statements = [*tree.body, *lazy_exports(tree)]
    seen = {
        alias.name: (statement.module or "").removeprefix("skillweave.")
        for statement in statements
        if isinstance(statement, ast.ImportFrom) and statement.module != "skillweave"
        for alias in statement.names
        if alias.asname == alias.name
    }
    here = module.removeprefix("skillweave.")
    seen |= {name: here for name, home in HOMES[module].items() if home == here}
    assert seen.items() >= HOMES[module].items()
    if file.name == "__init__.py":
        assert seen == HOMES[module] | HOMES.get(ALSO.get(module, ""), {})


def test_every_public_name_resolves_and_no_other_does():
    for module, name in PUBLIC_NAMES:
        found = getattr(import_module(module), name)
        assert found.__doc__
        if inspect.isclass(found) or inspect.isfunction(found):  # else a type alias
            assert found.__name__ == name
    with pytest.raises(AttributeError, match=r"no attribute 'PPPO': is 'PPO' meant\?"):
        _ = import_module("skillweave").PPPO


def test_a_name_that_is_elsewhere_is_found_there():
    for module, name in PUBLIC_NAMES:
        if module != "skillweave":
            with pytest.raises(AttributeError, match=f"no attribute '{name}': it is in {module}$"):
                getattr(import_module("skillweave"), name)
    with pytest.raises(AttributeError, match=r"no attribute 'PPO': it is in skillweave$"):
        _ = import_module("skillweave.algorithms").PPO


# Rules of names that stand in several files; docs/architecture.md explains them.
MIRRORED = "compat/agilerl/"  # AgileRL's own names of classes and files
# The settings, the base class of a room, the commands of the core and of an extension.
SAME_FILES = {"__init__.py", "config.py", "base.py", "commands.py"}
SAME_CLASSES = {"State"}  # of each algorithm


def test_a_name_of_a_class_or_file_has_one_meaning() -> None:
    """But those of the importer, and files that act what one of the same name declares."""
    classes: dict[str, set[str]] = {}
    files: dict[str, set[str]] = {}
    for path in MODULES:
        place = path.relative_to(ROOT).as_posix()
        if place.startswith(MIRRORED):
            continue
        files.setdefault(path.name, set()).add(place)
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ClassDef):
                classes.setdefault(node.name, set()).add(place)
    mapped = {"policies/mapped.py", "skills/mapped.py"}
    assert {k: v for k, v in classes.items() if len(v) > 1 and k not in SAME_CLASSES} == {}
    several = {k: v for k, v in files.items() if len(v) > 1 and k not in SAME_FILES}
    assert {k: v for k, v in several.items() if v != mapped} == {}
