"""An HTML page that needs nothing but itself: the templates, the charts' library, the data."""

from __future__ import annotations

import base64
import functools
import importlib
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skillweave.errors import needs_extra
from skillweave.reporting.report.facts import percent
from skillweave.runs.files import write_bytes

LOCAL = Path(__file__).parent / "templates"


@dataclass(frozen=True)
class Section:
    """A part of a page."""

    context: dict[str, Any]
    """What its words are made of, and its film."""
    data: dict[str, Any]
    """What its charts and film need, as plain JSON."""
    missing: list[str]
    """Sentences on what is not in it."""


def write_page(
    path: Path, template: str, context: dict[str, Any], data: dict[str, Any]
) -> dict[str, Any]:
    """Fill a template and write the page, whole or not at all.

    Args:
        template: a file in ``templates``.
        context: what its words are made of; ``film``: of episodes, and ``hand_film``: of calls of
            one skill after another, if there are any.
        data: what its charts and timelines are made of, as plain JSON without NaN.

    Returns:
        ``path`` and ``bytes``.

    Raises:
        RunError: it cannot be written.
        MissingExtra: the extra 'report' is not installed.
    """
    jinja2 = need("jinja2")
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(LOCAL),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["percent"] = percent
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    parts = {
        "style": (LOCAL / "style.css").read_text("utf-8"),
        "script": (LOCAL / "page.js").read_text("utf-8"),
        "library": library(),
        "data": data,
        "made": time.strftime("%Y-%m-%d %H:%M"),
    }
    films = {
        name: film and base64.b64encode(film.data).decode()
        for name in ("film", "hand_film")
        for film in [context.get(name)]
    }
    text = environment.get_template(template).render(parts | context | films).encode()
    write_bytes(path, text)
    return {"path": str(path), "bytes": len(text)}


@functools.cache
def library() -> str:
    """Return Vega, Vega-Lite and Vega-Embed as one script, about 900 kB."""
    bundle: str = need("vl_convert").javascript_bundle()
    # Within a page, a script would end at these letters.
    return bundle.replace("</script", "<\\/script").replace("<!--", "<\\!--")


def need(module: str) -> Any:
    """Return a module of the extra 'report'.

    Raises:
        MissingExtra: it is not installed.
    """
    with needs_extra("a report", "report"):
        return importlib.import_module(module)
