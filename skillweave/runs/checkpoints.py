"""The checkpoints of the stage under way: the latest, and the one before it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from torch import Tensor

from skillweave.errors import RunError, SkillweaveError
from skillweave.reading import fit
from skillweave.runs.files import move, read_header, read_tensors, remove, write_tensors


class Checkpoints:
    """Two files in a run; at every moment one of them is whole."""

    def __init__(self, directory: Path) -> None:
        names = "checkpoint.new", "checkpoint", "checkpoint.previous"
        self._files = [directory / f"{name}.safetensors" for name in names]

    def save(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
        """Write the latest; the one that was becomes the one before.

        Raises:
            RunError: the disk is full or cannot be written; there still is a whole one.
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
        self, stage: str, schema: Any, check: Callable[[dict[str, Any], Path], None]
    ) -> tuple[dict[str, Tensor], dict[str, Any], Path] | None:
        """Tensors and header of a stage's latest good one, and its file; None: there is none yet.

        Args:
            schema: of its header.
            check: given a header and its file, raises where they do not belong here.

        Raises:
            RunError: there are some of this stage, but none is good.
        """
        problems = []
        for path in self._files[1:]:
            if not os.path.lexists(path):
                continue
            try:
                tensors, header = read_tensors(path)
                if header.get("stage") != stage:
                    continue
                check(fit(schema, header, str(path)), path)
                return tensors, header, path
            except SkillweaveError as error:
                problems.append(str(error))
        if problems:
            raise RunError(
                "; ".join(problems) + f". Delete it to train the stage {stage!r} from its start"
            )
        return None

    def told(self) -> dict[str, Any]:
        """Return the header of the one that a resumed run goes on from; empty where there is none."""
        fresh, latest, before = self._files
        for path in (latest, fresh, before):  # as ``clear`` and ``load`` take them
            with suppress(RunError):
                return read_header(path)
        return {}

    def any(self) -> bool:
        """Return whether there is one."""
        return any(map(os.path.lexists, self._files))

    def keep(self, path: Path) -> None:
        """Move the latest to ``path``, if there is one, and remove the others.

        Raises:
            RunError: it cannot be moved, or the others cannot be removed.
        """
        if self._files[1].exists():
            move(self._files[1], path)
        self.drop()

    def drop_previous(self) -> bool:
        """Remove the one before the latest, if there is a latest; return whether it was there."""
        _, latest, before = self._files
        there = latest.exists() and before.exists()
        if there:
            remove(before)
        return there

    def drop(self) -> None:
        """Remove them: their stage is done, and ``run.json`` says so."""
        for path in self._files:
            remove(path)

    def clear(self, done: Sequence[str]) -> None:
        """Put in order what a killed process left; ``done`` are the stages that need none."""
        fresh, latest, _ = self._files
        if fresh.exists() and not latest.exists():  # killed between two renames: it is whole
            move(fresh, latest)
        remove(fresh)
        for path in self._files:
            with suppress(RunError):  # a damaged one is told when it is needed
                if path.exists() and read_header(path).get("stage") in done:
                    read_tensors(path)  # not on the word of a damaged header
                    remove(path)
