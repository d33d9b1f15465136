"""Environments: engines with one meaning of resets, and checks of environments."""

from typing import TYPE_CHECKING

from skillweave._internal.public import lazy

if TYPE_CHECKING:
    from skillweave.envs.pool import PoolWrapper as PoolWrapper, one_of as one_of
    from skillweave.hierarchy.options import OptionsEnv as OptionsEnv
else:
    __all__, __getattr__, __dir__ = lazy(__name__)
