"""What people are told to type works: it names the file with their code."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
from small_runs import small_manifest, stage_entry

from skillweave.runs.checkpoints import Checkpoints
from skillweave.runs.command_words import command_words, saved_words
from skillweave.runs.manifest import Checkpoint


@pytest.mark.parametrize(
    ("path", "recipe", "needs", "resume_needs", "evaluate", "resume"),
    [
        ("runs/a", "lunar-lander", True, True, "", ""),  # a shipped one is found by its name
        ("runs/a", "mine.py", True, True, " --recipe mine.py", " --recipe mine.py"),
        ("runs/a", "mine.py", False, True, "", " --recipe mine.py"),
        ("runs/a", None, True, True, " --recipe FILE.py", " --recipe FILE.py"),
        ("runs/a", None, False, False, "", ""),
        ("'my runs/a'", "my file.py", False, True, "", " --recipe 'my file.py'"),
    ],
)
def test_commands_name_the_users_file_where_it_is_needed(
    path, recipe, needs, resume_needs, evaluate, resume
):
    told = small_manifest(recipe=recipe, needs_recipe=needs, resume_needs_recipe=resume_needs)
    run = SimpleNamespace(path=Path(path.strip("'")), manifest=told)
    assert command_words("evaluate|render", run) == f"skillweave evaluate|render {path}{evaluate}"
    assert command_words("resume", run) == f"skillweave resume {path}{resume}"


def test_what_is_saved_is_what_a_resumed_run_goes_on_from(tmp_path):
    stages = [stage_entry("left"), stage_entry("right", "training")]
    run = SimpleNamespace(path=tmp_path, manifest=small_manifest(*stages))
    kept = Checkpoints(tmp_path)
    assert saved_words(run) == "saved after left"
    for steps in (100, 200):
        kept.save({}, Checkpoint("right", 1, steps, 0, 0.0, {}))
    assert saved_words(run) == "saved at 200 steps of right"
    names = "checkpoint", "checkpoint.new", "checkpoint.previous"
    latest, fresh, before = (tmp_path / f"{name}.safetensors" for name in names)
    shutil.copy(before, fresh)
    assert saved_words(run) == "saved at 200 steps of right", "one that was not moved is removed"
    latest.rename(fresh)
    assert saved_words(run) == "saved at 200 steps of right", "between two renames it is whole"
