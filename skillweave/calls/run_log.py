"""The log of calls in a run's directory, ``calls.safetensors``."""

from __future__ import annotations

import hashlib
import zlib
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from skillweave._internal.messages import shown_path
from skillweave._internal.notices import notice
from skillweave._internal.paths import CRITIC, SELECTOR
from skillweave.calls.call_file import LoggedRun, write_calls
from skillweave.calls.columns import columns_of
from skillweave.calls.handover import Handover
from skillweave.calls.log import CallLog, join
from skillweave.calls.recorder import MOST_BYTES
from skillweave.errors import RunError
from skillweave.policies.untrusted import check_file
from skillweave.runs.directory import CALLS, CALLS_LOCK, RunDirectory
from skillweave.runs.files import read_header
from skillweave.runs.lock import Lock
from skillweave.runs.user_code import changes
from skillweave.schema import fit

MOST_STEPS = 1_000_000
"""The most steps of the log in a run; the latest stay."""
LARGEST = MOST_BYTES + 64 * 2**20
"""The most bytes of its file."""
RECORD = "record a new log: run.log_calls(20_000), or skillweave log"


def load_calls(run: RunDirectory) -> CallLog | None:
    """Return the log of calls in a run, or None.

    Raises:
        RunError: the file is damaged, belongs to another run, or the skills have learnt on since.
    """
    path = run.path / CALLS
    if not path.exists():
        return None
    check_file(path, LARGEST)
    if (reason := _misfit(run)) is not None:
        raise RunError(f"{path} {reason}; {RECORD}")
    return CallLog.load(path)


def handover_of(run: RunDirectory) -> Handover | str | None:
    """Return the matrix of a run's log; a sentence where the log cannot be used; None without one.

    Reports about runs use it: a log that cannot be used is no reason to show nothing.
    """
    try:
        log = load_calls(run)
    except RunError as error:
        return str(error)
    return None if log is None else log.handover()


def handover_json(matrix: Handover | str | None) -> dict[str, Any]:
    """Return an entry of a run's description for what ``handover_of`` returned."""
    if matrix is None:
        return {}
    return {"handover": {"error": matrix} if isinstance(matrix, str) else matrix.to_json()}


def needed_calls(run: RunDirectory) -> CallLog:
    """Return the log of calls in a run; raise a RunError where there is none, or as above."""
    log = load_calls(run)
    if log is None:
        raise RunError(f"{shown_path(run.path)} has no log of calls; {RECORD}")
    return log


def log_so_far(run: RunDirectory) -> CallLog | None:
    """Return the log that new calls of a run will be joined with; None: they will replace it.

    Raises:
        RunError: the file cannot be read, so it is not replaced either.
    """
    path = run.path / CALLS
    if not path.exists():
        return None
    try:
        check_file(path, LARGEST)
        return CallLog.load(path) if _misfit(run) is None else None
    except RunError as error:
        raise RunError(f"{error}. Delete {path} to record a new log") from error


def save_calls(run: RunDirectory, log: CallLog) -> None:
    """Write calls into a run, joined with those that are there.

    A log of other skills, weights or ``info`` keys is replaced. One of an environment or of skills
    whose code has changed is put aside. A notice says so. Calls that were recorded again, with the
    same seeds and choices, are there once.

    Raises:
        RunError: the file cannot be written, or the one that is there cannot be read.
    """
    path = run.path / CALLS
    # A training holds the run's own lock for hours.
    lock = Lock(run.path, CALLS_LOCK, wait=True)
    try:
        if path.exists() and (reason := _misfit(run)) is not None:
            notice(f"{path} {reason}. The new log replaces it")
        elif path.exists():
            log = _joined_or_aside(path, log)
        log = _bounded(log)
        header = LoggedRun(id=run.manifest.id, skills=_weights(run))
        write_calls(path, log, header)
    finally:
        lock.release()


def _joined_or_aside(path: Path, log: CallLog) -> CallLog:
    """Return the log that is to be in a file; one of other code than before is put aside first."""
    before = CallLog.load(path)
    if not (says := changes(before.code, log.code)):
        return joined(before, log)
    names = (path.with_stem(f"{path.stem}-{n}") for n in count(1))
    aside = next(name for name in names if not name.exists())
    path.rename(aside)
    notice(
        f"{says} since the calls in {path} were recorded. They are now in {aside.name}, and the "
        "run's log begins again"
    )
    return log


def joined(old: CallLog, new: CallLog) -> CallLog:
    """Return both logs as one; of calls that are in both, with the same seeds, one stays.

    If they are of other skills, spaces or ``info`` keys, it is the new one, which a notice says.
    """
    again = set(_identities(new)) - {None}
    stay = np.array([identity not in again for identity in _identities(old)], bool)
    try:
        return join([old.take(np.flatnonzero(stay)), new])
    except RunError as error:
        reason = str(error).rpartition(";")[0] or error
        notice(f"the run's log of calls is replaced by the new one: {reason}")
        return new


def next_seed(log: CallLog | None) -> int:
    """Return a seed whose episodes a log does not have: 0 without one, else by its content."""
    if log is None:
        return 0
    content = b"".join(x.tobytes() for x in (log.seed, log.episode, log.choice))
    return zlib.crc32(content) >> 1


def _identities(log: CallLog) -> list[tuple[int, int] | None]:
    """Return the identity of each call: its episode's seed, and a checksum of choices so far.

    Two calls with the same are the same, as environments repeat themselves; None: unknown.
    """
    identities: list[tuple[int, int] | None] = [None] * len(log)
    tau = log.tau
    sums: dict[int, tuple[int, int]] = {}  # by episode: the number of calls, and their checksum
    for c in np.lexsort((log.order, log.episode)).tolist():
        episode, order = int(log.episode[c]), int(log.order[c])
        count, before = sums.get(episode, (0, 0))
        if count != order or log.seed[c] < 0:
            continue  # an earlier call of the episode is not there
        here = zlib.crc32(np.array([log.choice[c], tau[c]], np.int64).tobytes(), before)
        sums[episode] = (count + 1, here)
        identities[c] = (int(log.seed[c]), here)
    return identities


def _bounded(log: CallLog) -> CallLog:
    """Return the latest calls of a log, as many as fit into a run's file."""
    each = max(1, sum(column.nbytes for column in columns_of(log).values()) // max(1, log.steps))
    most = min(MOST_STEPS, MOST_BYTES // each)
    if log.steps <= most:
        return log
    notice(f"a run keeps its latest {most:,} logged steps; earlier calls are left out")
    return log.latest(most)


def _misfit(run: RunDirectory) -> str | None:
    """Return why the log in a run is not of its skills as they are now; None: it is."""
    path = run.path / CALLS
    header = read_header(path)
    if "run" not in header:
        return "was not written by this run"
    of: LoggedRun = fit(LoggedRun, header["run"], str(path), "run")
    if of.id != run.manifest.id:
        return "belongs to another run"
    if of.skills != _weights(run):
        return "is of the skills before they learnt on"
    return None


def _weights(run: RunDirectory) -> str:
    """Return a checksum of the weights of all skills of a run."""
    latest: dict[str, str] = {}
    for stage in run.manifest.stages:
        one = dict.fromkeys(stage.learns, stage.sha256 or "")
        latest |= stage.policies or one
    skills = sorted((name, sha) for name, sha in latest.items() if name not in (SELECTOR, CRITIC))
    return hashlib.sha256(repr(skills).encode()).hexdigest()
