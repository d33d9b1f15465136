"""The core without each extension, and a package that adds one of each kind."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from installed import EXTENSIONS
from test_structure import ROOT

import skillweave as sw
from skillweave import extensions
from skillweave.errors import DeclarationError, MissingExtra

pytestmark = pytest.mark.needs(*EXTENSIONS)
PAGE = ROOT.parent / "docs/howto/extensions.md"


class Left(sw.Skill):
    """Learn the environment's reward: a run of such skills is loaded without code."""

    max_steps = 3


class Right(Left):
    """As the other one."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> sw.Run:
    """A run with recorded calls."""
    ppo = sw.PPO(num_envs=2, n_steps=16)
    hierarchy = sw.Hierarchy("CartPole-v1", [Left(), Right()], algorithm=ppo, steps=96)
    run = hierarchy.train(tmp_path_factory.mktemp("extensions") / "run", quiet=True)
    run.log_calls(200)
    return run


def python(code: str, *paths: Path) -> str:
    """What a program prints, by packages in these places first."""
    places = os.pathsep.join(map(str, paths))
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": places},
        cwd=paths[0],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


# What fetches the things of an extension, and which names it lacks without them.
WITHOUT = """
import sys
import skillweave as sw
from importlib import import_module
from pathlib import Path
from skillweave.cli import main
from skillweave.extensions import SHIPPED, fetch_from, resolve
from skillweave.errors import MissingExtra

root = Path(sw.__file__).parent
for path in sorted(root.rglob("*.py")):
    parts = path.relative_to(root).with_suffix("").parts
    if parts[0] not in {extensions!r} and parts[-1] not in ("__main__", "runner"):
        import_module(".".join(["skillweave", *(p for p in parts if p != "__init__")]))
lacks = []
for kind, names in SHIPPED.items():
    for name in names:
        try:
            found = fetch_from(kind, name)
            if kind == "command":
                resolve(found[1])
        except MissingExtra as error:
            assert "skillweave." in str(error), error
            lacks.append(f"{{kind}}.{{name}}")
            if kind == "command":
                assert main([name]) == 1
print(*lacks)
"""
LACKS = {
    "planning": "function.explore function.plan command.plan",
    "html_report": "function.report command.report command.compare section.cuts",
    "repair": "function.repair function.repairs stage.repair",
    "recipes": "command.demo",
    "demo": "command.demo",
    "compat": "command.import-agilerl",
    "robots": "command.handover command.inputs",
    "data": "function.begin function.segment section.cuts",
}


@pytest.mark.parametrize("name", EXTENSIONS)
def test_the_core_works_without_an_extension_and_says_what_is_missing(
    name: str, tmp_path: Path
) -> None:
    shutil.copytree(ROOT, tmp_path / "skillweave", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.rmtree(tmp_path / "skillweave" / name)
    found = python(WITHOUT.format(extensions=sorted(EXTENSIONS)), tmp_path)
    assert sorted(found.splitlines()[-1].split()) == sorted(LACKS[name].split())


def test_a_name_that_no_extension_has_is_refused() -> None:
    with pytest.raises(DeclarationError, match=r"'plam'.*plan"):
        extensions.fetch("plam")
    with pytest.raises(ModuleNotFoundError, match="no_such") as raised:
        extensions.resolve("skillweave.planning.no_such:f", "x")
    assert not isinstance(raised.value, MissingExtra), "its room is there"
    with pytest.raises(MissingExtra, match=r"'x' needs skillweave\.nowhere"):
        extensions.resolve("skillweave.nowhere.there:f", "x")


# A package of somebody else: the one of the page


def toy(folder: Path) -> Path:
    """The page's package, built and installed; the folder that it is in."""
    text = PAGE.read_text()
    files = dict(re.findall(r"^[^\n]*`(skillweave_toy/\w+\.py)`[^\n]*:\n\n```py\n(.*?)^```", text,
                            flags=re.S | re.M))  # fmt: skip
    assert len(files) == 4
    (project,) = re.findall(r"^```toml\n(.*?)^```", text, flags=re.S | re.M)
    for name, content in {
        "pyproject.toml": project,
        "skillweave_toy/__init__.py": "",
        **files,
    }.items():
        place = folder / "source" / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(content)
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel"]
    subprocess.run(command, cwd=folder / "source", check=True, capture_output=True)
    (wheel,) = (folder / "source/dist").glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:  # as pip does
        archive.extractall(folder / "site")
    return folder / "site"


USE = """
import gymnasium, sys
import skillweave as sw
from pathlib import Path
from skillweave.cli import main
from skillweave.extensions import fetch

run = sw.load({run!r})
skill, steps = fetch("longest")(run)
assert steps == run.calls.tau.max() and skill in run.calls.skills
assert main(["longest", {run!r}]) == 0
Path("walk.lean").write_text("0.05")
env = gymnasium.make("CartPole-v1")
class Walk(sw.Skill):
    policy = "walk.lean"
lean = sw.from_function(lambda obs: obs[:, 2] > 0.05)
score = sw.evaluate(Walk().policy, "CartPole-v1", episodes=3)
assert score == sw.evaluate(lean, "CartPole-v1", episodes=3)
written = run.report("report.html", episodes=1, films=0, quiet=True)
assert f"<p>{{skill}}, {{steps}} steps</p>" in Path("report.html").read_text()
print("used")
"""


def test_a_package_adds_a_function_a_command_a_reader_and_a_section(
    run: sw.Run, tmp_path: Path
) -> None:
    pytest.importorskip("hatchling")
    site = toy(tmp_path)
    found = python(USE.format(run=str(run.path)), tmp_path, site, ROOT.parent)
    assert re.search(r"^(left|right), \d+ steps$", found, flags=re.M)
    assert found.splitlines()[-1] == "used"


def test_what_other_packages_add_wrongly_is_left_out_and_said(run: sw.Run, tmp_path: Path) -> None:
    info = tmp_path / "bad-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: bad\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[skillweave.extensions]\nfunction.plan = bad:f\nplugin.x = bad:f\n"
        "command.broken = bad:COMMAND\nsection.broken = bad:section\nsection.odd = bad:odd\n"
    )
    (tmp_path / "bad.py").write_text(
        "def section(about): raise KeyError('speed')\ndef odd(about): return 3\n"
    )
    code = (
        "import skillweave as sw\nfrom skillweave.cli.commands import all_commands\n"
        "from skillweave.extensions import names_of\n"
        f"run = sw.load({str(run.path)!r})\n"
        "assert names_of('function')['plan'].startswith('skillweave.')\n"
        "assert 'broken' not in all_commands() and 'train' in all_commands()\n"
        "print(*run.report('r.html', episodes=1, films=0, quiet=True)['missing'], sep='\\n')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT.parent)])},
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "no section 'broken': KeyError: 'speed'" in done.stdout
    assert "no section 'odd': TypeError: it must return a Section or None" in done.stdout
    for said in (
        "the function 'plan', which is there",
        "'plugin.x', whose kind",
        "'broken' cannot",
    ):
        assert said in done.stderr
