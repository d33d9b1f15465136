"""``skillweave import-agilerl``: convert a checkpoint of AgileRL."""

from __future__ import annotations

from skillweave.cli.output import Result
from skillweave.compat.commands import ImportAgilerlCommand
from skillweave.errors import DeclarationError


def import_agilerl(command: ImportAgilerlCommand) -> Result:
    """Carry out ``skillweave import-agilerl``: convert a checkpoint of AgileRL."""
    if not command.trust:
        raise DeclarationError(
            f"{command.file} would be read as a pickle, and pickles can run code. This one is read "
            "by an unpickler that admits only tensors, numbers and plain containers; if you trust "
            "where it comes from nevertheless, say so: --trust"
        )
    # Here: AgileRL's names come with its ids of environments, and its way with wandb.
    from skillweave.compat.agilerl_files import convert

    out = command.out or command.file.with_suffix(".safetensors")
    algo = convert(command.file, out)
    text = f"wrote {out}: a {algo} agent, for {algo}.load of skillweave.compat.agilerl"
    return {"path": str(out), "algorithm": algo}, text
