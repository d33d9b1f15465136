"""The checkpoints of the stage in training: the latest, and the one before it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from torch import Tensor

from skillweave.errors import RunError, SkillweaveError
from skillweave.runs.files import (
    move,
    read_header,
    read_tensors,
    record_in,
    remove,
    write_tensors,
)
from skillweave.runs.manifest import Checkpoint


class Checkpoints:
    """Two files in a run, of which one is complete at any moment."""

    def __init__(self, directory: Path) -> None:
        names = "checkpoint.new", "checkpoint", "checkpoint.previous"
        self._files = [directory / f"{name}.safetensors" for name in names]

    def save(self, tensors: Mapping[str, Tensor], header: Checkpoint) -> None:
        """Write the latest checkpoint; the previous latest one stays beside it.

        Raises:
            RunError: the disk is full or cannot be written; a complete one still exists.
        """
        fresh, latest, before = self._files
        write_tensors(fresh, tensors, header, make_directories=False)
        try:
            if latest.exists():
                move(latest, before)
            move(fresh, latest)
        except SkillweaveError:
            with suppress(OSError):
                fresh.unlink(missing_ok=True)
            raise

    def load(
        self, stage: str, check: Callable[[str | None, Path], None]
    ) -> tuple[dict[str, Tensor], Checkpoint] | None:
        """Return tensors and header of a stage's latest good checkpoint; None: it has none.

        Args:
            stage: its name.
            check: raises where the ``id`` of a file's run is not the one of this run.

        Raises:
            RunError: checkpoints of this stage exist, but all are damaged.
        """
        problems = []
        for path in self._files[1:]:
            if not os.path.lexists(path):
                continue
            try:
                tensors, header = read_tensors(path, most=None)
                if header.get("stage") != stage:
                    continue
                checkpoint: Checkpoint = record_in(Checkpoint, header, path)
                check(checkpoint.run, path)
                return tensors, checkpoint
            except SkillweaveError as error:
                problems.append(str(error))
        if problems:
            raise RunError(
                "; ".join(problems) + f". Delete it to train the stage {stage!r} from its start"
            )
        return None

    def latest_header(self) -> Checkpoint | None:
        """Return the header of the checkpoint that a resumed run loads; None: it has none."""
        fresh, latest, before = self._files
        for path in (latest, fresh, before):  # the order of ``clear`` and ``load``
            with suppress(RunError):
                checkpoint: Checkpoint = record_in(Checkpoint, read_header(path), path)
                return checkpoint
        return None

    def any(self) -> bool:
        """Return whether a checkpoint exists."""
        return any(map(os.path.lexists, self._files))

    def keep(self, path: Path) -> None:
        """Move the latest to ``path``, if it exists, and remove the others.

        Raises:
            RunError: a file cannot be moved or removed.
        """
        if self._files[1].exists():
            move(self._files[1], path)
        self.drop()

    def drop_previous(self) -> bool:
        """Remove the one before the latest, if both exist; return whether it was removed."""
        _, latest, before = self._files
        both = latest.exists() and before.exists()
        if both:
            remove(before)
        return both

    def drop(self) -> None:
        """Remove all checkpoints, after ``run.json`` marks their stage as done."""
        for path in self._files:
            remove(path)

    def clear(self, done: Sequence[str]) -> None:
        """Clean up after a killed process; ``done`` are the stages that need no checkpoint."""
        fresh, latest, _ = self._files
        if fresh.exists() and not latest.exists():  # killed between two renames: it is complete
            move(fresh, latest)
        remove(fresh)
        for path in self._files:
            with suppress(RunError):  # a damaged one raises when it is needed
                if path.exists() and read_header(path).get("stage") in done:
                    read_tensors(path, most=None)  # a header alone may be damaged
                    remove(path)
