"""Recipes that are files: what lies beside them is imported, and their errors are one line."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from single_step import step_of

from skillweave import recipes
from skillweave.errors import DeclarationError
from skillweave.workers import shipping
from skillweave.workers.shipping import packed

RECIPE = """
from skillweave import Hierarchy, Skill, PPO
from beside_rewards import centre

class Center(Skill):
    def reward(self, step):
        from beside_lazily import scale
        return scale * centre(step)

tiny = PPO(num_envs=2, n_steps=8, batch_size=16, update_epochs=1)
hierarchy = Hierarchy("CartPole-v1", [Center()], algorithm=tiny, selector=tiny)
"""
REWARDS = "def centre(step):\n    return 1.0 - abs(step.next_obs[:, 0])\n"
Write = Callable[..., str]


@pytest.fixture(autouse=True)
def forget(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a test imports, and the folders that it adds, are forgotten after it."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(shipping, "_FOLDERS", [])
    known = set(sys.modules)
    yield
    for name in set(sys.modules) - known:
        if name.startswith(("beside_", "skillweave_recipe_")):
            del sys.modules[name]
    importlib.invalidate_caches()


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def write(folder: str, **files: str) -> str:
        """Write files into a folder; the path of the first."""
        (tmp_path / folder).mkdir(exist_ok=True)
        for name, text in files.items():
            (tmp_path / folder / f"{name}.py").write_text(text)
        importlib.invalidate_caches()
        return str(tmp_path / folder / f"{next(iter(files))}.py")

    return write


def test_files_beside_a_recipe_are_imported_also_later(write: Write) -> None:
    recipe = write("a", pole=RECIPE, beside_rewards=REWARDS, beside_lazily="scale = 2.0\n")
    (center,) = recipes.load(recipe).skills
    step = step_of(np.zeros((1, 4)), np.full((1, 4), 0.25))
    assert center.reward(step).tolist() == [1.5]


@pytest.mark.slow
def test_what_is_imported_later_is_found_in_another_process_too(
    write: Write, tmp_path: Path
) -> None:
    recipe = write("a", pole=RECIPE, beside_rewards=REWARDS, beside_lazily="scale = 3.0\n")
    file = tmp_path / "packed"
    file.write_bytes(packed(recipes.load(recipe), "it"))
    code = (
        "from types import SimpleNamespace as S; import numpy as np\n"
        "from skillweave.workers.shipping import unpacked\n"
        f"own = unpacked(open({str(file)!r}, 'rb').read())\n"
        "print(own.skills[0].reward(S(next_obs=np.zeros((1, 4)))))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert done.stdout == "[3.]\n"


def test_two_recipes_with_files_of_one_name_are_refused_and_not_mixed(write: Write) -> None:
    first = write("a", pole=RECIPE, beside_rewards=REWARDS, beside_lazily="scale = 1.0\n")
    second = write("b", pole=RECIPE, beside_rewards=REWARDS, beside_lazily="scale = 2.0\n")
    one = recipes.load(first)
    told = r"b/pole.py imports 'beside_rewards'.*a/beside_rewards.py\). Rename beside_rewards.py"
    with pytest.raises(DeclarationError, match=told):
        recipes.load(second)
    lazily = RECIPE.replace("from beside_rewards import centre", "centre = abs")
    third = write("c", pole=lazily, beside_lazily="scale = 2.0\n")
    with pytest.raises(DeclarationError, match=r"imports 'beside_lazily'.*a/beside_lazily.py"):
        recipes.load(third)
    assert sys.modules[type(one.skills[0]).__module__].__file__ == first


def test_files_that_one_another_import_and_files_named_like_a_package_are_looked_at_too(
    write: Write,
) -> None:
    plain = RECIPE.replace("        from beside_lazily import scale\n", "        scale = 1\n")
    recipes.load(write("a", pole=plain, beside_rewards=REWARDS))
    more = "import beside_rewards\n"
    second = write("b", pole=plain.replace("beside_rewards", "beside_more"), beside_more=more)
    write("b", beside_rewards=REWARDS)
    with pytest.raises(DeclarationError, match="imports 'beside_rewards'"):
        recipes.load(second)
    unrelated = RECIPE.replace("from beside_rewards import centre", "centre = abs")
    recipes.load(write("c", pole=unrelated, json="raise ValueError\n"))
    recipe = write("d", pole="import json\n" + unrelated, json="x = 1\n")
    with pytest.raises(DeclarationError, match=r"imports 'json': beside it lies json.py"):
        recipes.load(recipe)


def test_recipes_of_one_name_do_not_replace_one_another(write: Write) -> None:
    plain = RECIPE.replace("from beside_rewards import centre", "centre = abs")
    one, two = (recipes.load(write(folder, pole=plain)) for folder in ("a", "b"))
    modules = [type(h.skills[0]).__module__ for h in (one, two)]
    assert modules == ["skillweave_recipe_pole", "skillweave_recipe_pole_2"]
    again = recipes.load(two.recipe or "")
    assert type(again.skills[0]).__module__ == modules[1]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x = 1\ny = x +\n", r"bad.py raised SyntaxError: invalid syntax \(bad.py, line 2\)$"),
        ("import nowhere_to_be_found", r"No module named 'nowhere_to_be_found' \(bad.py, line 1\)"),
        (
            "import skillweave as sw\n\nsw.PPO(gamma=9)",
            r"bad.py: .*gamma is 9.* \(bad.py, line 3\)$",
        ),
        ("import sys\nsys.exit()", r"ends Python while it is read \(bad.py, line 2\)"),
        ("import beside_bad", r"ZeroDivisionError: division by zero \(beside_bad.py, line 2\)$"),
    ],
)
def test_an_error_is_one_line_with_file_and_line(write: Write, text: str, says: str) -> None:
    recipe = write("a", bad=text, beside_bad="\n1 / 0\n")
    with pytest.raises(DeclarationError, match=says) as caught:
        recipes.load(recipe)
    assert str(caught.value).startswith(recipe)
    assert "\n" not in str(caught.value)
    assert "skillweave_recipe_bad" not in sys.modules


@pytest.mark.slow
def test_the_command_line_imports_what_lies_beside_and_tells_errors_in_one_line(
    write: Write, tmp_path: Path
) -> None:
    recipe = write("a", pole=RECIPE, beside_rewards=REWARDS, beside_lazily="scale = 2.0\n")

    def info(file: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "skillweave", "info", file]
        return subprocess.run(command, check=False, capture_output=True, text=True, cwd=tmp_path)

    assert "call_steps=" in info(recipe).stdout
    bad = write("a", bad="def reward(:\n")
    done = info(bad)
    assert done.returncode == 1
    assert done.stderr == f"error: {bad} raised SyntaxError: invalid syntax (bad.py, line 1)\n"
