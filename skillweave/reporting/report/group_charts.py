"""The charts of a comparison: several groups of seeds in one picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from skillweave.reporting.report.charts import STEPS, Spec, chart, number_axis, steps_axis


def _color(field: str, names: Sequence[str], colors: Sequence[str]) -> dict[str, Any]:
    """Return the colours of groups by their letters; the page has the legend."""
    scale = {"domain": list(names), "range": list(colors)}
    return {"field": field, "type": "nominal", "scale": scale, "legend": None}


def scores(
    names: Sequence[str], colors: Sequence[str], rows: dict[str, Any], binary: bool = False
) -> Spec:
    """Return a chart with a dot for each run, and each group's interquartile mean and interval.

    Args:
        binary: returns are 0 or 1, so that their mean is the share of episodes that are solved.
    """
    what, form = ("episodes solved", ".0%") if binary else ("mean return", ",.4~r")
    y = {
        "field": "group",
        "type": "nominal",
        "title": None,
        "sort": list(names),
        "axis": {"labelFontSize": 14, "labelFontWeight": "bold"},
    }
    color = _color("group", names, colors)
    axis: dict[str, Any] = {"tickCount": 8} | ({"format": "%"} if binary else {})
    x = number_axis("x", f"{what} of a run", axis=axis)
    tooltip = [
        {"field": "group"},
        {"field": "x", "title": "interquartile mean", "format": form},
        {"field": "low", "title": "from", "format": form},
        {"field": "high", "title": "to", "format": form},
    ]
    run = [
        {"field": "group"},
        {"field": "seed"},
        {"field": "x", "title": what, "format": form},
    ]
    between = {"x": {"field": "low", "type": "quantitative"}, "x2": {"field": "high"}}
    layer: list[Spec] = [
        {
            "data": {"values": rows["bars"]},
            "transform": [{"filter": "isValid(datum.low)"}],
            "mark": {"type": "rule", "strokeWidth": 5, "opacity": 0.5, "aria": False},
            "encoding": {**between, "y": y, "color": color, "tooltip": tooltip},
        },
        {
            "data": {"values": rows["dots"]},
            "mark": {"type": "point", "size": 50, "strokeWidth": 1.5, "aria": False},
            "encoding": {"x": x, "y": y, "color": color, "tooltip": run},
        },
        {
            "data": {"values": rows["bars"]},
            "mark": {"type": "tick", "thickness": 4, "size": 22, "aria": False},
            "encoding": {"x": x, "y": y, "color": color, "tooltip": tooltip},
        },
    ]
    if not any("low" in bar for bar in rows["bars"]):
        del layer[0]  # an axis over nothing is warned of
    return chart("Scores by group", 50 + 40 * len(names), layer=layer)


def group_curves(label: str, names: Sequence[str], colors: Sequence[str]) -> Spec:
    """Return a chart of an agent's metric, with a line and a band for each group."""
    color = _color("what", names, colors)
    tooltip = [
        {"field": "what", "title": "group"},
        {"field": "x", "title": STEPS, "format": ",d"},
        {"field": "y", "title": "value", "format": ",.4~r"},
        {"field": "lo", "title": "from", "format": ",.4~r"},
        {"field": "hi", "title": "to", "format": ",.4~r"},
    ]
    band = {"type": "area", "opacity": 0.2, "aria": False, "tooltip": False}
    line = {"type": "line", "strokeWidth": 2, "aria": False}
    dot = {"type": "point", "opacity": 0, "size": 80, "filled": True, "aria": False}
    low_high = {"y": number_axis("lo", ""), "y2": {"field": "hi"}}
    encoding = {"x": steps_axis(), "color": color}
    layer: list[Spec] = [
        {"mark": band, "encoding": low_high},
        {"mark": line, "encoding": {"y": number_axis("y", "")}},
        {"mark": dot, "encoding": {"y": number_axis("y", ""), "tooltip": tooltip}},
    ]
    return chart(f"Learning curves of {label}", 220, encoding=encoding, layer=layer)
