"""Help and wrong arguments are instant: neither torch nor gymnasium is imported for them."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = ("torch", "gymnasium", "numpy", "safetensors", "envpool", "skillweave.api")

PROBE = """
import runpy, sys
try:
    code = runpy.run_module("skillweave", run_name="__main__", alter_sys=True)
except SystemExit as end:
    code = end.code
heavy = [name for name in {heavy!r} if name in sys.modules]
print("CODE", code, "HEAVY", ",".join(heavy), file=sys.stderr)
"""


def probe(*arguments: str) -> tuple[int, list[str]]:
    """A command's exit code, and which heavy modules it left imported."""
    command = [sys.executable, "-c", PROBE.format(heavy=HEAVY), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    line = done.stderr.splitlines()[-1].split()
    assert (line[0], line[2]) == ("CODE", "HEAVY")
    return int(line[1]), line[3].split(",") if len(line) > 3 else []


@pytest.mark.fast_cases(4)
@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        ["train", "--help"],
        [],
        ["trian", "lunar-lander"],
        ["train"],
        ["train", "lunar-lander", "--sed", "3"],
        ["train", "lunar-lander", "--seed", "three"],
        ["train", "lunar-lander", "--track", "nothing"],
        ["evaluate", "run", "--episodes"],
    ],
    ids=lambda arguments: " ".join(arguments) or "nothing",
)
def test_help_and_argument_errors_import_nothing_heavy(arguments):
    code, heavy = probe(*arguments)
    assert code == (0 if "--help" in arguments else 2)
    assert heavy == []


@pytest.mark.slow
def test_the_probe_sees_what_a_real_command_imports():
    code, heavy = probe("list")
    assert code == 0
    assert {"torch", "gymnasium"} <= set(heavy)


def test_importing_the_package_imports_nothing_heavy_until_a_name_is_used():
    code = "import sys, skillweave\n"
    code += f"print([n for n in {HEAVY!r} if n in sys.modules])\n"
    code += "skillweave.PPO, skillweave.Skill, skillweave.from_onnx, skillweave.from_torch\n"
    code += "print('torch' in sys.modules)\n"
    code += "skillweave.Hierarchy\nprint('torch' in sys.modules)\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:3] == ["[]", "False", "True"]
