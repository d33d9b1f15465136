"""Sharing runs by the Hugging Face Hub: push one, and load one that somebody has pushed."""

from __future__ import annotations

import secrets
import shutil
import tempfile
from pathlib import Path
from typing import Any

from skillweave.api import Agent, Hierarchy, Run
from skillweave.api.loading import check_declared, load_from
from skillweave.arguments import checked_names
from skillweave.errors import RunError, SkillweaveError
from skillweave.messages import as_path
from skillweave.reporting.card import write_card
from skillweave.reporting.plots import plot_run
from skillweave.runs import hub
from skillweave.runs.directory import RunDirectory
from skillweave.training.evaluation_file import load_evaluation

ASK = (
    "Pass the hierarchy that was trained, if you have its code and trust it: "
    "from_hub(name, hierarchy)"
)


def push_run(path: Path, name: str, private: bool = False) -> dict[str, Any]:
    """Put the run at ``path`` on the hub; see ``Run.push``."""
    hub.hub()  # a missing extra is said first
    run, name = RunDirectory.open(path), hub.check_name(name)
    hub.must_be_own(run.path)
    hub.check_whole(run)
    files: dict[str, Path | bytes] = {}
    own, stays = hub.run_files(run)
    films, missing = hub.run_films(run), [f"{f} is no safetensors file: it stays" for f in stays]
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
        files["README.md"] = write_card(run, name, **shown).encode()
        files |= own | {p.name: p for p in films} | figures
        told = hub.upload(name, files, private)
    return {**told, "files": list(files), "missing": missing}


@checked_names
def from_hub(
    name: str, hierarchy: Hierarchy | Agent | None = None, *, revision: str | None = None
) -> Run:
    """Load a run from the Hugging Face Hub, as ``hierarchy.load`` loads one from a folder.

    Only data comes from there: safetensors and JSON, checked like any run's files. It needs the
    extra ``hub``. The files are kept where ``huggingface_hub`` keeps its own (``HF_HOME``), and
    without a network a run is loaded from there. Nothing is written into that copy: to save an
    evaluation or a report in the run, take a copy of your own (``skillweave pull``).

    Args:
        name: ``owner/name``.
        hierarchy: what was trained, where acting needs its Python code; None: not needed, or a
            recipe that is shipped.
        revision: a branch, a tag or a commit; None: the latest.

    Returns:
        The finished run.

    Raises:
        RunError: there is no such run, it holds a file that is not data, it is damaged, it
            needs code that was not given, or the hub does not answer.
        MissingExtra: the extra 'hub' is not installed.
    """
    check_declared(hierarchy)
    return load_from(hub.download(hub.check_name(name), revision), hierarchy, ask=ASK)


def pull_run(name: str, path: str | Path, revision: str | None = None) -> Path:
    """Copy a run from the hub into a new folder; errors are those of ``from_hub``."""
    path = as_path(path, "path")
    if path.exists():
        raise RunError(f"{path} is there already; choose another folder")
    found = hub.download(hub.check_name(name), revision)
    manifest = hub.public(RunDirectory.open(found).manifest)  # others may have pushed all of it
    # A name that cannot be guessed: a link that waits there would lead elsewhere.
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.mkdir()
        (part / "policies").mkdir()
        for file in (f for pattern in hub.WANTED for f in found.glob(pattern)):
            shutil.copy(file, part / file.relative_to(found))
        RunDirectory(part, manifest).save()
        part.rename(path)
    except OSError as error:
        raise RunError(f"could not write {path}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return path
