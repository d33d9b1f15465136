"""The timeline of calls that were found in data: by hand, as a picture, and in a run's report."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from test_begin import demonstrator, hierarchy, spec

import skillweave as sw
from skillweave.errors import DeclarationError

SVG = "{http://www.w3.org/2000/svg}"


def lifts() -> sw.Dataset:
    """Two episodes of Lift: one whole, and one in which nothing is ever gripped."""
    down = np.float32([0.35, 0.25, 0.15, 0.05])
    up = np.arange(0.05, 0.9, 0.1, dtype=np.float32)
    whole = np.stack([np.append(down, up), np.repeat([0, 1], [4, 9])], axis=1)
    never = np.stack([np.full(4, 0.3), np.zeros(4)], axis=1)
    episodes: list[Any] = [
        {"observations": whole, "actions": [0] * 3 + [2] + [1] * 8},
        {"observations": never, "actions": [2] * 3},
    ]
    return sw.Dataset(episodes, spec(), name="<lifts>")


def test_the_picture_has_a_bar_for_each_call(tmp_path: Path) -> None:
    found = hierarchy().segment(lifts())
    cuts = found.cuts()
    assert cuts.skills == ["reach", "grip", "raise"]
    assert cuts.lengths == [12, 3]
    assert cuts.calls == [[(0, 0, 3), (1, 3, 1), (2, 4, 8)], []]
    root = ElementTree.parse(found.save(tmp_path / "cuts.svg")).getroot()
    titles = [x.text for x in root.iter(f"{SVG}title")]
    assert titles == [
        "reach", "grip", "raise",
        "reach: steps 1 to 3", "grip: steps 4 to 4", "raise: steps 5 to 12",
    ]  # fmt: skip
    bars = [x for x in root.iter(f"{SVG}rect") if x[0].text in titles[3:]]
    widths = [float(x.attrib["width"]) + 0.5 for x in bars]
    assert widths[0] / widths[1] == pytest.approx(3, rel=0.02)
    page = found.save(tmp_path / "cuts.html").read_text()
    assert "&lt;lifts&gt;" in page
    assert "20.0% of 15 steps are claimed by no skill" in page
    with pytest.raises(DeclarationError, match=r"it must end with \.svg or \.html"):
        found.save(tmp_path / "cuts.png")


@pytest.mark.needs("html_report")
def test_the_report_shows_the_data_that_a_run_began_with(tmp_path: Path) -> None:
    data = sw.record(demonstrator, spec(), episodes=40, seed=5)
    run = hierarchy().train(tmp_path / "run", data=data, quiet=True)
    run.report(tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "The data, cut into calls of skills" in page
    assert "10 more episodes are not shown" in page
    nothing = hierarchy().train(tmp_path / "nothing", quiet=True)
    nothing.report(tmp_path / "other.html")
    assert "cut into calls" not in (tmp_path / "other.html").read_text()
