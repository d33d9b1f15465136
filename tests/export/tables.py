"""Networks are exported again and again here: torch's table of operators is made once."""

import functools
from collections.abc import Iterator

import pytest


@pytest.fixture(scope="session", autouse=True)
def one_table_of_operators() -> Iterator[None]:
    """Half of the seconds of an export go into this table, which is the same each time."""
    try:
        from torch.onnx._internal.exporter._registration import ONNXRegistry as table
    except ImportError:  # a torch that has it elsewhere: it is made again each time
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(table, "from_torchlib", staticmethod(functools.cache(table.from_torchlib)))
        yield
