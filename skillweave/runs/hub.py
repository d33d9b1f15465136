"""Runs on the Hugging Face Hub: what goes up and what comes down is data, never code.

The hub's own library talks to it (``huggingface_hub``, the extra 'hub'): it knows the login
(``hf auth login`` or HF_TOKEN), the address (HF_ENDPOINT) and where downloads are kept (HF_HOME).
"""

from __future__ import annotations

import copy
import importlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from skillweave.errors import DeclarationError, MissingExtra, RunError
from skillweave.messages import short, shortened
from skillweave.runs.command_words import resume_words
from skillweave.runs.directory import RunDirectory
from skillweave.runs.files import json_bytes
from skillweave.runs.hub_errors import asking, status_of
from skillweave.runs.links import check_no_links_around

KINDS = (".safetensors", ".json", ".jsonl", ".md", ".gif", ".mp4", ".png")
"""Suffixes of files that may be in a run on the hub: weights, settings, its card, its pictures."""
MADE_BY_THE_HUB = ".gitattributes"
LINES = ("run.json", "evaluation.json", "metrics.jsonl", "lineage.jsonl")
WANTED = (*LINES, "policies/*.safetensors")
"""What is downloaded: what a run is read from."""
FILMS = (".gif", ".mp4")
FIGURES = "figures"
"""The folder of pictures on the hub."""
SECONDS = 20.0
"""How long an answer may take."""


def hub() -> Any:
    """Return the hub's library.

    Raises:
        MissingExtra: it is not installed.
    """
    try:
        return importlib.import_module("huggingface_hub")
    except ImportError as error:
        raise MissingExtra("sharing runs", "hub") from error


def hub_api() -> Any:
    """Who talks to the hub; errors are those of ``hub``."""
    from importlib.metadata import version

    return hub().HfApi(library_name="skillweave", library_version=version("skillweave"))


def check_name(name: object) -> str:
    """``name`` as one of a repository on the hub.

    Raises:
        DeclarationError: it is no name like ``owner/name``.
    """
    part = r"\w([\w.-]{0,94}\w)?"
    if not isinstance(name, str) or not re.fullmatch(f"{part}/{part}", name, re.ASCII):
        raise DeclarationError(
            f"{short(name)} is no name on the hub; write owner/name: letters, digits, '-', '_', '.'"
        )
    return name


# Up


def check_whole(run: RunDirectory) -> None:
    """Read all that a run holds, so that nothing unfinished or damaged goes up.

    Raises:
        RunError: the run is not finished, or a file is damaged.
    """
    if not run.finished:
        waiting = [s["name"] for s in run.manifest["stages"] if s["status"] != "done"]
        what = f"the stage {waiting[0]!r} is not done" if waiting else "it is not judged yet"
        raise RunError(
            f"{run.path} is not finished ({what}), and only finished runs can be shared. Go on "
            f"with it: {resume_words(run)}"
        )
    for stage in run.manifest["stages"]:
        run.load_policies(stage["name"])
    for lines in (run.metrics(), run.lineage.read()):
        for _ in lines:
            pass


def public(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of ``run.json`` without what is its owner's alone; its id stays what it is.

    That is where files lie on the owner's machine, and which trackers are told of the run: who
    loads it must not tell theirs.
    """
    told = copy.deepcopy(dict(manifest))
    if told.get("track"):
        told["track"] = []
    policies = [skill.get("policy", {}) for skill in told.get("skills", ())]
    for holder, key in ((told, "recipe"), *((policy, "file") for policy in policies)):
        if holder.get(key):
            holder[key] = PureWindowsPath(holder[key]).name  # it knows both kinds of slashes
    return told


def run_files(run: RunDirectory) -> tuple[dict[str, Path | bytes], list[str]]:
    """Return the files of a run that go up, by their names there; and files that must stay here.

    What stays are copies of policies that are neither safetensors nor JSON.
    """
    found: dict[str, Path | bytes] = {
        name: run.path / name for name in LINES if (run.path / name).exists()
    }
    found["run.json"] = json_bytes(run.path / "run.json", public(run.manifest))
    stays = []
    for path in sorted((run.path / "policies").glob("[!.]*")):
        if path.suffix == ".safetensors":
            found[f"policies/{path.name}"] = path
        else:
            stays.append(f"policies/{path.name}")
    return found, stays


def run_films(run: RunDirectory) -> list[Path]:
    """Films that lie in the run's folder."""
    return sorted(p for p in run.path.iterdir() if p.suffix in FILMS and p.is_file())


def upload(name: str, files: Mapping[str, Path | bytes], private: bool = False) -> dict[str, str]:
    """Put files on the hub in one commit: all of them, or none. What is there of an older run goes.

    Args:
        name: ``owner/name``; made if it is not there.
        files: by their names there.
        private: others may not read it.

    Returns:
        ``url`` and ``commit``.

    Raises:
        RunError: it may not be written, it holds something else, or the hub does not answer.
        MissingExtra: the extra 'hub' is not installed.
    """
    library, api = hub(), hub_api()
    with asking(api, name, writes=True):
        api.create_repo(name, private=private or None, exist_ok=True)
        info = api.model_info(name, timeout=SECONDS)
        there = [file.rfilename for file in info.siblings or ()]
        _may_be_replaced(name, there)
        if private and info.private is False:
            raise RunError(
                f"{name} is public already: make it private on its page, or choose another name"
            )
        changes = [library.CommitOperationAdd(path, content) for path, content in files.items()]
        gone = [path for path in there if _of_a_run(path) and path not in files]
        changes += [library.CommitOperationDelete(path) for path in gone]
        done = api.create_commit(
            name, changes, commit_message="Upload a run of Skillweave", parent_commit=info.sha
        )
    return {"url": f"{api.endpoint}/{name}", "commit": str(done.oid)}


def _may_be_replaced(name: str, there: Sequence[str]) -> None:
    """Raise where a repository holds something that is no run, or that loading would refuse."""
    if others := _refused(there):
        raise RunError(
            f"{name} holds {others}, which is no part of a run, so nobody could load one from "
            "there. Delete it on the hub, or choose another name; nothing was pushed"
        )
    found = [f for f in there if f not in ("README.md", MADE_BY_THE_HUB)]
    if found and "run.json" not in there:
        raise RunError(
            f"{name} holds something else ({shortened(', '.join(found), 200)}); choose another "
            "name. Nothing was pushed"
        )


def _of_a_run(path: str) -> bool:
    """Return whether it is a file that ``push`` writes, and so may delete."""
    found = PurePosixPath(path)
    if str(found.parent) in ("policies", FIGURES):
        return True
    return path in LINES or (path == found.name and found.suffix in FILMS)


# Down


def must_be_own(folder: Path) -> None:
    """Raise a RunError where a folder is in the cache of the hub's library.

    What is written there would be loaded the next time as if its owner had pushed it. A folder in a
    run that holds links is refused, too.
    """
    if (name := _copied_from(folder)) is not None:
        raise RunError(
            f"{folder} is the copy of {name} that huggingface_hub keeps: nothing is written there "
            "or pushed from there, as it would be taken for its owner's. Take a copy of your own, "
            f"and use that: skillweave pull {name}"
        )
    check_no_links_around(folder)


def is_copy_of_hub(folder: Path) -> bool:
    """Return whether a folder is in the cache of the hub's library."""
    return _copied_from(folder) is not None


def _copied_from(folder: Path) -> str | None:
    """Return the run's name on the hub; None: the folder is not in the cache."""
    found = folder.resolve()
    for place in (found, *found.parents):
        kind, *name = place.parent.parent.name.split("--")
        if place.parent.name == "snapshots" and kind == "models" and len(name) == 2:
            return "/".join(name)
    return None


def download(name: str, revision: str | None = None) -> Path:
    """Return the folder, in the cache of the hub's library, with a run's files.

    Where the hub does not answer, what was downloaded before is taken.

    Args:
        name: ``owner/name``.
        revision: a branch, a tag or a commit; None: the latest.

    Raises:
        RunError: there is no such run, it holds files that are not data, or the hub does not
            answer.
        DeclarationError: ``revision`` is no text.
        MissingExtra: the extra 'hub' is not installed.
    """
    api = hub_api()
    if revision is not None and not (isinstance(revision, str) and revision):
        raise DeclarationError(
            f"revision is {short(revision)}; it must be a branch, a tag or a commit"
        )
    with asking(api, name, revision=revision):
        info = _info(api, name, revision)
        how = {"revision": revision, "allow_patterns": list(WANTED)}
        if isinstance(info, Exception):  # no answer
            path = _downloaded_before(api, name, how, info)
        else:
            _check_kinds(name, [file.rfilename for file in info.siblings or ()])
            path = Path(api.snapshot_download(name, **how))
            if path.name != info.sha:
                raise RunError(f"{name} was changed while it was downloaded; try again")
    return path


def _info(api: Any, name: str, revision: str | None) -> Any:
    """What the hub says of a repository, or the error where it does not answer."""
    try:
        return api.model_info(name, revision=revision, timeout=SECONDS)
    except Exception as error:
        if status_of(error) is None or status_of(error) >= 500:
            return error
        raise


def _downloaded_before(api: Any, name: str, how: Mapping[str, Any], error: Exception) -> Path:
    """Return the folder of an earlier download; where there is none, ``error`` is raised."""
    try:
        return Path(api.snapshot_download(name, local_files_only=True, **how))
    except Exception:
        raise error from None


def _check_kinds(name: str, files: Sequence[str]) -> None:
    """Raise where there is no run, or something that is not data."""
    if others := _refused(files):
        raise RunError(
            f"{name} holds {others}, and a run on the hub is data alone ({', '.join(KINDS)}): "
            "nothing of it is used. Ask who made it to remove that"
        )
    if "run.json" not in files:
        raise RunError(f"{name} holds no run of Skillweave: there is no run.json")


def _refused(files: Sequence[str]) -> str:
    """Return the files that are of no known kind, as words; empty: there are none."""
    others = [short(f) for f in files if not _is_data(f)]
    more = f" and {len(others) - 3} more" if len(others) > 3 else ""
    return ", ".join(others[:3]) + more


def _is_data(file: str) -> bool:
    path = PurePosixPath(file)
    inside = not path.is_absolute() and ".." not in path.parts and "\\" not in file
    return file == MADE_BY_THE_HUB or (inside and path.suffix in KINDS)
