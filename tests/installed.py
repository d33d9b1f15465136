"""The public names of what is installed: somebody may work on the core without an extension."""

from __future__ import annotations

from importlib.util import find_spec

from skillweave._internal import public

EXTENSIONS: dict[str, set[str]] = {
    "planning": set(),
    "html_report": set(),
    "repair": set(),
    "recipes": set(),
    "demo": {"recipes"},
    "compat": set(),
    "robots": set(),
    "data": {"html_report"},
}
"""What each extension may import beside the core: the extensions that it stands on."""

HOMES = {
    module: {
        name: home
        for name, home in homes.items()
        if find_spec(f"skillweave.{home.split('.')[0]}") is not None
    }
    for module, homes in public.HOMES.items()
    if find_spec(module)
}
"""By module that users import from: its names, each with the module that defines it."""
