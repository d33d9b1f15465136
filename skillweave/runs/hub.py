"""Runs on the Hugging Face Hub: uploads and downloads are data, never code.

All requests use the hub's library (``huggingface_hub``, the extra 'hub'), which handles the login
(``hf auth login`` or HF_TOKEN), the address (HF_ENDPOINT) and the cache (HF_HOME).
"""

from __future__ import annotations

import copy
import importlib
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from skillweave._internal.messages import short, shortened
from skillweave.errors import DeclarationError, RunError, SkillweaveError, needs_extra
from skillweave.runs.command_words import resume_words
from skillweave.runs.directory import CALLS, RunDirectory
from skillweave.runs.files import check_no_links_around, json_bytes
from skillweave.runs.manifest import Manifest

KINDS = (".safetensors", ".json", ".jsonl", ".md", ".gif", ".mp4", ".png")
"""Suffixes of files that may be in a run on the hub: weights, settings, its card, its pictures."""
MADE_BY_THE_HUB = ".gitattributes"
LINES = ("run.json", "evaluation.json", "metrics.jsonl", "lineage.jsonl")
WANTED = (*LINES, CALLS, "policies/*.safetensors")
"""The downloaded files, from which a run is read."""
OF_A_POLICY = ("policy.json", "*.onnx", "arrays.npz")
"""The downloaded files, from which a policy is read."""
FILMS = (".gif", ".mp4")
FIGURES = "figures"
"""The folder of pictures on the hub."""
SECONDS = 20.0
"""The longest wait for an answer."""


def hub() -> Any:
    """Return the hub's library.

    Raises:
        MissingExtra: it is not installed.
    """
    with needs_extra("sharing runs", "hub"):
        return importlib.import_module("huggingface_hub")


def hub_api() -> Any:
    """Return the client of the hub's library; raise the errors of ``hub``."""
    from importlib.metadata import version

    return hub().HfApi(library_name="skillweave", library_version=version("skillweave"))


def check_name(name: object) -> str:
    """Return ``name`` if it is a valid name of a repository on the hub.

    Raises:
        DeclarationError: it is not a name like ``owner/name``.
    """
    part = r"\w([\w.-]{0,94}\w)?"
    if not isinstance(name, str) or not re.fullmatch(f"{part}/{part}", name, re.ASCII):
        raise DeclarationError(
            f"{short(name)} is no name on the hub; write owner/name: letters, digits, '-', '_', '.'"
        )
    return name


# Up


def check_whole(run: RunDirectory) -> None:
    """Read all files of a run, so that no unfinished or damaged one is uploaded.

    Raises:
        RunError: the run is not finished, or a file is damaged.
    """
    if not run.finished:
        waiting = [s.name for s in run.manifest.stages if not s.done]
        reason = f"the stage {waiting[0]!r} is not done" if waiting else "it is not compared yet"
        raise RunError(
            f"{run.path} is not finished ({reason}), and only finished runs can be shared. "
            f"Continue it: {resume_words(run)}"
        )
    for stage in run.manifest.stages:
        run.load_policies(stage.name)
    for lines in (run.metrics(), run.lineage.read()):
        for _ in lines:
            pass


def public(manifest: Manifest) -> Manifest:
    """Return the content of ``run.json`` without the owner's private entries; the id is unchanged.

    Private are paths on the owner's machine, and the trackers of the run, which another user's
    training must not write to.
    """
    content = copy.deepcopy(manifest)
    content.track = ()
    if content.recipe:
        content.recipe = PureWindowsPath(content.recipe).name  # it splits at both kinds of slashes
    for skill in content.skills:
        if skill.policy is not None and skill.policy.file:
            skill.policy.file = PureWindowsPath(skill.policy.file).name
    return content


def run_files(run: RunDirectory, calls: bool = False) -> tuple[dict[str, Path | bytes], list[str]]:
    """Return a run's files to upload, by their names on the hub; and the files that stay.

    Copies of policies that are neither safetensors nor JSON stay.

    Args:
        calls: with the log of calls.
    """
    files: dict[str, Path | bytes] = {
        name: run.path / name
        for name in (*LINES, *([CALLS] if calls else []))
        if (run.path / name).exists()
    }
    files["run.json"] = json_bytes(run.path / "run.json", public(run.manifest))
    stays = []
    for path in sorted((run.path / "policies").glob("[!.]*")):
        if path.suffix == ".safetensors":
            files[f"policies/{path.name}"] = path
        else:
            stays.append(f"policies/{path.name}")
    return files, stays


def run_films(run: RunDirectory) -> list[Path]:
    """Return the films in the run's folder."""
    return sorted(p for p in run.path.iterdir() if p.suffix in FILMS and p.is_file())


def upload(name: str, files: Mapping[str, Path | bytes], private: bool = False) -> dict[str, str]:
    """Upload files in one commit, all or none; delete the files of an older run there.

    Args:
        name: ``owner/name``; created if it does not exist.
        files: files by their names on the hub.
        private: others may not read it.

    Returns:
        ``url`` and ``commit``.

    Raises:
        RunError: it may not be written, it holds other files, or the hub does not answer.
        MissingExtra: the extra 'hub' is not installed.
    """
    library = hub()
    api = hub_api()
    with hub_errors(api, name, writes=True):
        api.create_repo(name, private=private or None, exist_ok=True)
        info = api.model_info(name, timeout=SECONDS)
        existing = [file.rfilename for file in info.siblings or ()]
        _may_be_replaced(name, existing)
        if private and info.private is False:
            raise RunError(
                f"{name} is public already: make it private on its page, or choose another name"
            )
        changes = [library.CommitOperationAdd(path, content) for path, content in files.items()]
        gone = [path for path in existing if _of_a_run(path) and path not in files]
        changes += [library.CommitOperationDelete(path) for path in gone]
        commit = api.create_commit(
            name, changes, commit_message="Upload a run of Skillweave", parent_commit=info.sha
        )
    return {"url": f"{api.endpoint}/{name}", "commit": str(commit.oid)}


def _may_be_replaced(name: str, existing: Sequence[str]) -> None:
    """Raise where a repository holds files that are no run, or that loading would refuse."""
    if others := _refused(existing):
        raise RunError(
            f"{name} holds {others}, which is no part of a run, so a run there could not be "
            "loaded. Delete it on the hub, or choose another name; nothing was pushed"
        )
    content = [f for f in existing if f not in ("README.md", MADE_BY_THE_HUB)]
    if content and "run.json" not in existing:
        raise RunError(
            f"{name} holds other files ({shortened(', '.join(content), 200)}); choose another "
            "name. Nothing was pushed"
        )


def _of_a_run(path: str) -> bool:
    """Return whether ``push`` writes such a file, and so may delete it."""
    file = PurePosixPath(path)
    if str(file.parent) in ("policies", FIGURES):
        return True
    return path in (*LINES, CALLS) or (path == file.name and file.suffix in FILMS)


# Down


def must_be_own(folder: Path) -> None:
    """Raise a RunError where a folder is in the cache of the hub's library.

    A file written there would later be loaded as if its owner had pushed it. A folder in a run with
    links is refused, too.
    """
    if (name := _copied_from(folder)) is not None:
        raise RunError(
            f"{folder} is the copy of {name} in the cache of huggingface_hub: nothing is written "
            "or pushed from there, because it would count as its owner's. Make your own copy and "
            f"use it: skillweave pull {name}"
        )
    check_no_links_around(folder)


def is_copy_of_hub(folder: Path) -> bool:
    """Return whether a folder is in the cache of the hub's library."""
    return _copied_from(folder) is not None


def _copied_from(folder: Path) -> str | None:
    """Return the run's name on the hub; None: the folder is not in the cache."""
    resolved = folder.resolve()
    for place in (resolved, *resolved.parents):
        kind, *name = place.parent.parent.name.split("--")
        if place.parent.name == "snapshots" and kind == "models" and len(name) == 2:
            return "/".join(name)
    return None


def download(name: str, revision: str | None = None, *, policy: bool = False) -> Path:
    """Return the folder, in the cache of the hub's library, with a run's files.

    If the hub does not answer, use an earlier download.

    Args:
        name: ``owner/name``.
        revision: a branch, a tag or a commit; None: the latest.
        policy: the files of a policy instead, ``policy.json`` and ONNX; others stay there.

    Raises:
        RunError: the run does not exist, it holds files that are not data, or the hub does not
            answer.
        DeclarationError: an argument is wrong.
        MissingExtra: the extra 'hub' is not installed.
    """
    check_name(name)
    api = hub_api()
    if revision is not None and not (isinstance(revision, str) and revision):
        raise DeclarationError(
            f"revision is {short(revision)}; it must be a branch, a tag or a commit"
        )
    with hub_errors(api, name, revision=revision):
        info = _info(api, name, revision)
        wanted = OF_A_POLICY if policy else WANTED
        options = {"revision": revision, "allow_patterns": list(wanted)}
        if isinstance(info, Exception):  # no answer
            path = _downloaded_before(api, name, options, info)
        else:
            _check_files(name, [file.rfilename for file in info.siblings or ()], policy)
            path = Path(api.snapshot_download(name, **options))
            if path.name != info.sha:
                raise RunError(f"{name} was changed while it was downloaded; try again")
    return path


def _info(api: Any, name: str, revision: str | None) -> Any:
    """Return the hub's description of a repository, or the error if the hub does not answer."""
    try:
        return api.model_info(name, revision=revision, timeout=SECONDS)
    except Exception as error:
        if status_of(error) is None or status_of(error) >= 500:
            return error
        raise


def _downloaded_before(api: Any, name: str, options: Mapping[str, Any], error: Exception) -> Path:
    """Return the folder of an earlier download; raise ``error`` if it does not exist."""
    try:
        return Path(api.snapshot_download(name, local_files_only=True, **options))
    except Exception:
        raise error from None


def _check_files(name: str, files: Sequence[str], policy: bool) -> None:
    """Raise a RunError where files are not those of a policy; or of a run, and only data."""
    if policy and "policy.json" not in files:
        raise RunError(f"{name} holds no policy of Skillweave: it has no policy.json")
    if policy:
        return
    if others := _refused(files):
        raise RunError(
            f"{name} holds {others}, and a run on the hub is data alone ({', '.join(KINDS)}): "
            "nothing of it is used. Ask its owner to remove that"
        )
    if "run.json" not in files:
        raise RunError(f"{name} holds no run of Skillweave: it has no run.json")


def _refused(files: Sequence[str]) -> str:
    """Return the files of unknown kinds, in words; empty: all are known."""
    others = [short(f) for f in files if not _is_data(f)]
    more = f" and {len(others) - 3} more" if len(others) > 3 else ""
    return ", ".join(others[:3]) + more


def _is_data(file: str) -> bool:
    path = PurePosixPath(file)
    inside = not path.is_absolute() and ".." not in path.parts and "\\" not in file
    return file == MADE_BY_THE_HUB or (inside and path.suffix in KINDS)


# Errors of the hub's library, as sentences


@contextmanager
def hub_errors(
    api: Any, name: str, *, writes: bool = False, revision: str | None = None
) -> Iterator[None]:
    """Convert errors of the hub's library within the block to a RunError."""
    try:
        yield
    except SkillweaveError:
        raise
    except Exception as error:  # of any library that it uses
        raise RunError(_sentence(error, api.endpoint, name, writes, revision)) from error


def status_of(error: BaseException | None) -> Any:
    """Return the status code of the hub's answer; None: it did not answer."""
    while error is not None:
        if (response := getattr(error, "response", None)) is not None:
            return response.status_code
        error = error.__cause__
    return None


def _sentence(
    error: Exception, endpoint: str, name: str, writes: bool, revision: str | None
) -> str:
    """Return a sentence on an error of the Hugging Face Hub, and its remedy."""
    errors = importlib.import_module("huggingface_hub.errors")
    status = status_of(error)
    login = "log in (hf auth login), or set HF_TOKEN"
    if isinstance(error, errors.GatedRepoError):
        return f"{name} is gated: ask for access on {endpoint}/{name}, then {login}"
    if isinstance(error, errors.RevisionNotFoundError):
        return f"{name} has no revision {short(revision)}; look at {endpoint}/{name}/commits/main"
    if status == 401 and writes:
        return f"{endpoint} does not recognise you: {login} to a token that may write"
    if status == 403 and writes:
        return (
            f"you may not write to {name}: its owner must be you or an organisation of yours, and "
            "your token one that may write"
        )
    if status in (401, 403, 404) or isinstance(error, errors.RepositoryNotFoundError):
        return (
            f"{endpoint} has no {name}, or it is private and you may not read it. Check the name; "
            f"if it is private, {login}"
        )
    what = shortened(f"{type(error).__name__}: {error}".replace("\n", " "), 300)
    if status is not None:
        return f"{endpoint} refused {name} with the answer {status}; try again later. {what}"
    if isinstance(error, errors.HFValidationError) or type(error) is ValueError:  # no request
        return f"{name} is refused: {what}"
    after = "Nothing was pushed" if writes else f"This machine has no copy of {name}"
    return (
        f"{endpoint} cannot be reached. {after}. Check the network, HF_ENDPOINT and "
        f"HF_HUB_OFFLINE, then try again. {what}"
    )
