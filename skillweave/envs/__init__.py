"""Environments, many at once: engines that step and reset them, and checks of what they answer.

Begin with ``engine``; ``make`` declares an environment and chooses its engine.
"""

from typing import TYPE_CHECKING

from skillweave._internal.public import lazy

if TYPE_CHECKING:
    from skillweave.api.make_options import make_options_env as make_options_env
    from skillweave.envs.pool import (
        PoolWrapper as PoolWrapper,
        envpool as envpool,
        one_of as one_of,
    )
    from skillweave.hierarchy.options_env import OptionsEnv as OptionsEnv
else:
    __all__, __getattr__, __dir__ = lazy(__name__)
