"""Upload a run to the Hugging Face Hub, and download one."""

from __future__ import annotations

import secrets
import shutil
import tempfile
from pathlib import Path
from typing import Any

from skillweave._internal.messages import as_path
from skillweave.calls.run_log import needed_calls
from skillweave.errors import RunError, SkillweaveError
from skillweave.reporting.card import write_card
from skillweave.reporting.plots import plot_run
from skillweave.runs import hub
from skillweave.runs.directory import RunDirectory
from skillweave.training.evaluation_file import load_evaluation


def push_run(path: Path, name: str, private: bool = False, calls: bool = False) -> dict[str, Any]:
    """Put the run at ``path`` on the hub; see ``Run.push``."""
    hub.hub()  # a missing extra is reported first
    run, name = RunDirectory.open(path), hub.check_name(name)
    hub.must_be_own(run.path)
    hub.check_whole(run)
    if calls:
        needed_calls(run)
    run_files, stays = hub.run_files(run, calls)
    films = hub.run_films(run)
    missing = [f"{f} is no safetensors file: it stays" for f in stays]
    if not films:
        missing.append(f"no film: skillweave render {path} --out {path / 'film.gif'}")
    if load_evaluation(run) is None:
        missing.append(f"no evaluation: skillweave evaluate {path}")
    with tempfile.TemporaryDirectory() as folder:
        try:
            drawn = [p for p in plot_run(run, Path(folder)) if p.suffix == ".png"]
        except SkillweaveError as error:
            drawn = []
            missing.append(f"no figures: {error}")
        figures = {f"{hub.FIGURES}/{p.name}": p for p in drawn}
        shown = {"films": [p.name for p in films], "figures": list(figures)}
        card = write_card(run, name, **shown).encode()
        files = {"README.md": card, **run_files, **{p.name: p for p in films}, **figures}
        uploaded = hub.upload(name, files, private)
    return {**uploaded, "files": list(files), "missing": missing}


def pull_run(name: str, path: str | Path, revision: str | None = None) -> Path:
    """Copy a run from the hub into a new folder; errors are those of ``from_hub``."""
    path = as_path(path, "path")
    if path.exists():
        raise RunError(f"{path} is there already; choose another folder")
    copy = hub.download(name, revision)
    manifest = hub.public(RunDirectory.open(copy).manifest)  # others may have pushed all of it
    # A name that cannot be guessed: a link that waits there would lead elsewhere.
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.mkdir()
        (part / "policies").mkdir()
        for file in (f for pattern in hub.WANTED for f in copy.glob(pattern)):
            shutil.copy(file, part / file.relative_to(copy))
        RunDirectory(part, manifest).save()
        part.rename(path)
    except OSError as error:
        raise RunError(f"could not write {path}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return path
