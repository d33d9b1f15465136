"""Act by a policy that Skillweave exported; needs NumPy and onnxruntime, and nothing else.

    runner = Runner("lander-onnx", code={"engines off.condition": landed})
    runner.reset()                     # at the start of every episode
    action = runner.act(observation)   # at every step
    action = runner.act(observation, skill="wave")  # by remote control, in place of the selector

Python code is given by name; it receives observations in batches, (n, ...).
"""

import sys
from importlib import import_module, util
from pathlib import Path
from typing import Any


def _package() -> str:
    """Return the name of the package that acts: beside this file, or in Skillweave."""
    folder = Path(__file__).resolve().with_name("skillweave_policies")
    if not folder.is_dir():
        return "skillweave.policies"
    name = f"{folder.name}_{abs(hash(folder))}"  # each export has its own
    if name not in sys.modules:
        spec = util.spec_from_file_location(
            name, folder / "__init__.py", submodule_search_locations=[str(folder)]
        )
        assert spec is not None
        sys.modules[name] = util.module_from_spec(spec)
    return name


PACKAGE = _package()
Actor: Any = import_module(f"{PACKAGE}.actor").Actor


class Runner(Actor):  # type: ignore[misc]
    """The policy of one environment; ``code`` has the functions that ``policy.json`` lists."""

    def __init__(self, path: Any, code: Any = None, seed: Any = None, nan: Any = "error"):
        policy = import_module(f"{PACKAGE}.codec").read_folder(path, code)[0]
        super().__init__(policy, seed=seed, nan=nan)
