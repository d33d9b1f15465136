"""An HTML page that needs nothing but itself: the templates, the charts' library, the data."""

from __future__ import annotations

import base64
import functools
import importlib
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from skillweave.errors import SkillweaveError, needs_extra
from skillweave.reporting.facts import percent
from skillweave.runs.files import write_bytes

LOCAL = Path(__file__).parent / "templates"


@dataclass
class Page:
    """A page that is being made; each section puts its parts into it."""

    context: dict[str, Any] = field(default_factory=dict)
    """Values for the page's template; ``film``: of episodes, and ``hand_film``: of calls of one
    skill after another, if there are any."""
    data: dict[str, Any] = field(default_factory=dict)
    """Data of the page's charts and films, as plain JSON without NaN."""
    missing: list[str] = field(default_factory=list)
    """Sentences on what is not in it."""
    began: float = field(default_factory=time.perf_counter)

    @contextmanager
    def without(self, what: str) -> Iterator[None]:
        """Leave out what cannot be made in this block: the page says that there ``what``, and why.

        Args:
            what: "is no film", say.
        """
        try:
            yield
        except SkillweaveError as error:
            self.missing.append(f"There {what}: {str(error).rstrip('.')}.")

    def write(self, path: Path, template: str) -> dict[str, Any]:
        """Fill a template and write the page, whole or not at all.

        Args:
            path: the file.
            template: a file in ``templates``.

        Returns:
            ``path``, ``bytes``, and the ``seconds`` since the page was begun.

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
        environment.filters["base64"] = lambda content: base64.b64encode(content).decode()
        environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
        text = environment.get_template(template).render(
            self.context,
            missing=self.missing,
            data=self.data,
            style=(LOCAL / "style.css").read_text("utf-8"),
            script=(LOCAL / "page.js").read_text("utf-8"),
            library=library(),
            made=time.strftime("%Y-%m-%d %H:%M"),
        )
        write_bytes(path, text.encode())
        seconds = round(time.perf_counter() - self.began, 2)
        return {"path": str(path), "bytes": len(text.encode()), "seconds": seconds}


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
