"""The report: its size, the time to write it, and what a browser and axe-core say of it.

    python -m benchmarks.report [RUN]

Without a run, lunar-lander is trained for a twentieth of its budget; it then hovers, so its film is
about as long as one can be. The time is that of the whole command, with imports.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.common import report, run_command

SKILLWEAVE = (sys.executable, "-m", "skillweave")


def in_browser(path: Path) -> dict[str, Any]:
    """Return the console's messages, network requests, and serious findings of axe-core."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        return {"browser": None}
    from axe_playwright_python.sync_playwright import Axe
    from playwright.sync_api import sync_playwright

    said: list[str] = []
    asked: list[str] = []
    with sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        page = chromium.new_page()
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        began = time.perf_counter()
        page.goto(path.as_uri())
        page.wait_for_function("document.querySelector('.chart svg')")
        opened = time.perf_counter() - began
        found = Axe().run(page).response["violations"]
        chromium.close()
    serious = [v["id"] for v in found if v["impact"] in ("serious", "critical")]
    network = [url for url in asked if url.split(":")[0] not in ("file", "blob", "data")]
    return {
        "seconds_to_open": round(opened, 2),
        "console": said,
        "network": network,
        "axe": len(found),
        "axe_serious": serious,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", nargs="?", type=Path)
    run = parser.parse_args().run
    with tempfile.TemporaryDirectory() as folder:
        if run is None:
            run = Path(folder) / "run"
            train = ["train", "lunar-lander", "--scale", "0.05", "--quiet", "-o", str(run)]
            run_command([*SKILLWEAVE, *train], capture=True)
        page = Path(folder) / "report.html"
        began = time.perf_counter()
        words = ["report", str(run), "-o", str(page), "--json"]
        page_result = json.loads(run_command([*SKILLWEAVE, *words], capture=True).stdout)
        seconds = time.perf_counter() - began
        size = {"megabytes": round(page_result["bytes"] / 1e6, 2), "seconds": round(seconds, 2)}
        report("report", size | {"missing": page_result["missing"]} | in_browser(page))


if __name__ == "__main__":
    main()
