"""The charts of reports, as specifications in Vega-Lite; the page gives them its colours.

A specification is plain data, and holds its data. ``vega`` in a browser draws
it (https://vega.github.io/vega-lite/docs/).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from skillweave.reporting.lineage import Born, Lineage, changes_words, setting_title
from skillweave.reporting.palette import RGB, is_light

Spec = dict[str, Any]
STEPS = "environment steps"


def chart(description: str, height: int, **rest: Any) -> Spec:
    """Return the specification that all charts share, as wide as its place in the page."""
    schema = "https://vega.github.io/schema/vega-lite/v6.json"
    size = {
        "width": "container",
        "height": height,
        "autosize": {"type": "fit", "contains": "padding"},
    }
    return {"$schema": schema, "description": description, **size, **rest}


def number_axis(field: str, title: str, **rest: Any) -> dict[str, Any]:
    """Return the encoding of a number whose axis need not include zero."""
    scale = {"zero": False, "nice": True} | rest.pop("scale", {})
    return {"field": field, "type": "quantitative", "title": title, "scale": scale} | rest


def steps_axis(field: str = "x", title: str = STEPS) -> dict[str, Any]:
    """Return the encoding of steps: 200k, 1M."""
    label = "datum.value === 0 ? '0' : format(datum.value, '~s')"
    axis = {"labelExpr": label, "tickCount": 5, "labelOverlap": True}
    return number_axis(field, title, axis=axis, scale={"zero": True, "nice": False})


def hover(fields: Sequence[dict[str, Any]], color: dict[str, Any]) -> list[Spec]:
    """Return layers that show the nearest point under the pointer, with a box of its values."""
    near = {
        "name": "near",
        "select": {
            "type": "point",
            "on": "pointerover",
            "nearest": True,
            "encodings": ["x"],
            "clear": "pointerout",
        },
    }
    opacity = {"condition": {"param": "near", "empty": False, "value": 1}, "value": 0}
    mark = {"type": "point", "filled": True, "size": 60, "aria": False}
    return [
        {
            "params": [near],
            "mark": mark,
            "encoding": {"opacity": opacity, "color": color, "tooltip": list(fields)},
        }
    ]


def curve(label: str, color: str) -> Spec:
    """Return a chart of one agent's metric; the page sets its values and its name."""
    hue = {"value": color}
    tooltip = [
        {"field": "x", "type": "quantitative", "title": STEPS, "format": ",d"},
        {"field": "y", "type": "quantitative", "title": "value", "format": ",.4~r"},
    ]
    mark = {"type": "line", "strokeWidth": 2, "strokeJoin": "round", "aria": False}
    layers = [{"mark": mark, "encoding": {"color": hue}}, *hover(tooltip, hue)]
    encoding = {"x": steps_axis(), "y": number_axis("y", "", axis={"tickCount": 5})}
    return chart(f"Learning curve of {label}", 190, encoding=encoding, layer=layers)


def choices(skills: Sequence[str], colors: Sequence[str], *, goals: bool = False) -> Spec:
    """Return a chart of decisions over two coordinates; the page sets values and names.

    Args:
        skills: their names.
        colors: of each skill.
        goals: the values have goals, in words.
    """
    scale = {"domain": list(skills), "range": list(colors)}
    shapes = ["circle", "square", "triangle-up", "diamond", "cross", "triangle-down"]
    shape = {"domain": list(skills), "range": [shapes[i % len(shapes)] for i in range(len(skills))]}
    legend = {"orient": "top", "title": None, "symbolOpacity": 1}
    encoding = {
        "x": number_axis("x", "", axis={"tickCount": 8}),
        "y": number_axis("y", ""),
        "color": {"field": "what", "type": "nominal", "scale": scale, "legend": legend},
        "shape": {"field": "what", "type": "nominal", "scale": shape},
        "tooltip": [
            {"field": "what", "title": "chosen"},
            {"field": "x", "format": ",.4~r"},
            {"field": "y", "format": ",.4~r"},
            *([{"field": "goal"}] if goals else []),
        ],
    }
    mark = {"type": "point", "filled": True, "size": 45, "opacity": 0.85, "aria": False}
    return chart("The selector's choices over two coordinates", 360, mark=mark, encoding=encoding)


def handover(names: tuple[str, str]) -> Spec:
    """Return a chart of calls over two coordinates, by what became of them.

    Args:
        names: of calls that were done, and of others.
    """
    spec = choices(names, ["#009e73", "#d55e00"])
    spec["encoding"]["shape"]["scale"]["range"] = ["circle", "cross"]
    spec["encoding"]["tooltip"][0]["title"] = "call"
    return spec | {"description": "The chosen calls over two coordinates", "height": 300}


def goal_map(name: str, rows: Sequence[dict[str, Any]], ranges: Sequence[Sequence[float]]) -> Spec:
    """Return a map of success over goals of two numbers: parts of the space, by colour.

    Args:
        rows: the parts that have calls.
        ranges: the lowest and the highest value of each number.
    """
    encoding: dict[str, Any] = {"tooltip": _of_goals()}
    titles = ("first number of the goal", "second number of the goal")
    for axis, title, span in zip("xy", titles, ranges, strict=True):
        scale: dict[str, Any] = {"nice": False, "domain": list(span)}
        encoding[axis] = number_axis(axis, title, axis={"tickCount": 5}, scale=scale)
        encoding[f"{axis}2"] = {"field": f"{axis}2"}
    legend = {"format": ".0%", "title": "success", "gradientLength": 240, "tickCount": 3}
    hues = {"domain": [0, 1], "range": ["#d55e00", "#f0e442", "#009e73"]}
    encoding["color"] = {"field": "share", "type": "quantitative", "scale": hues, "legend": legend}
    mark = {"type": "rect", "aria": False}
    text = f"Success of {name} over its goals"
    return chart(text, 340, data={"values": list(rows)}, mark=mark, encoding=encoding)


def goal_bars(name: str, rows: Sequence[dict[str, Any]], ranges: Sequence[Sequence[float]]) -> Spec:
    """Return bars of success over goals of one number: a bar for each goal, or part of its range.

    What has calls has a pale ground, so that no success and no call are different.

    Args:
        rows: the goals or parts that have calls.
        ranges: the lowest and the highest value of the number; empty: goals are choices.
    """
    parts = bool(ranges)
    x: dict[str, Any] = {"field": "x", "type": "ordinal", "title": "goal", "sort": None}
    x |= {"axis": {"labelAngle": 0}}
    if parts:
        scale = {"nice": False, "domain": list(ranges[0])}
        x = number_axis("x", "goal", axis={"tickCount": 5}, scale=scale)
    shared = {"x": x, "tooltip": _of_goals()} | ({"x2": {"field": "x2"}} if parts else {})
    y = number_axis("share", "success", axis={"format": ".0%"}, scale={"domain": [0, 1]})
    mark = {"type": "rect" if parts else "bar", "aria": False}
    layer = [
        {
            "mark": mark | {"color": color, "opacity": opacity},
            "encoding": {"y": top, "y2": {"datum": 0}},
        }
        for color, opacity, top in (("#888888", 0.2, y | {"field": "top"}), ("#009e73", 1.0, y))
    ]
    values = [row | {"top": 1} for row in rows]
    text = f"Success of {name} by its goals"
    return chart(text, 240, data={"values": values}, encoding=shared, layer=layer)


def _of_goals() -> list[dict[str, Any]]:
    return [
        {"field": "share", "type": "quantitative", "title": "success", "format": ".0%"},
        {"field": "calls", "type": "quantitative", "title": "calls", "format": ",d"},
    ]


def family_tree(lineage: Lineage, color: str) -> Spec:
    """Return a chart of fitness by generation, each member joined to its parent."""
    path = {(b.generation, b.member) for b in lineage.path(lineage.winner)}
    dots = []
    lines = []
    for key, born in lineage.born.items():
        if born.fitness is None:
            continue
        dot: dict[str, Any] = {
            "x": born.generation + 1,
            "y": round(born.fitness, 3),
            "won": key in path,
        }
        what = "winner's line" if key in path else "other members"
        dot |= {"member": born.member, "how": what_changed(born), "what": what}
        dots.append(dot)
        parent = lineage.parent(born)
        if parent is not None and parent.fitness is not None:
            ends: dict[str, Any] = {"x2": parent.generation + 1, "y2": round(parent.fitness, 3)}
            lines.append({k: dot[k] for k in ("x", "y", "won", "what")} | ends)
    axis = {"tickMinStep": 1, "format": "d"}
    x = number_axis("x", "generation", axis=axis)
    y = number_axis("y", "fitness: mean return")
    of = {"domain": ["winner's line", "other members"], "range": [color, "#8d8d97"]}
    legend = {"orient": "top", "title": None, "symbolType": "circle"}
    hue = {"field": "what", "type": "nominal", "scale": of, "legend": legend}
    tooltip = [
        {"field": "member"},
        {"field": "x", "title": "generation"},
        {"field": "y", "title": "fitness", "format": ",.4~r"},
        {"field": "how", "title": "changed"},
    ]
    joined = {"x": x, "y": y, "x2": {"field": "x2"}, "y2": {"field": "y2"}, "color": hue}
    thick = {"condition": {"test": "datum.won", "value": 2.5}, "value": 1}
    big = {"condition": {"test": "datum.won", "value": 70}, "value": 25}
    layer: list[Spec] = [
        {
            "data": {"values": lines},
            "mark": {"type": "rule", "aria": False},
            "encoding": joined | {"strokeWidth": thick},
        },
        {
            "data": {"values": dots},
            "mark": {"type": "circle", "opacity": 1, "aria": False},
            "encoding": {"x": x, "y": y, "color": hue, "size": big, "tooltip": tooltip},
        },
    ]
    return chart("Fitness by generation, and the line of the winner", 320, layer=layer)


def setting_paths(lineage: Lineage, color: str) -> list[tuple[str, Spec]]:
    """Return a chart for each setting that differed: its values by generation."""
    everyone = list(lineage.born.values())
    path = lineage.path(lineage.winner)
    return [(k, _setting(k, everyone, path, color)) for k in lineage.varied]


def _setting(name: str, everyone: Sequence[Born], path: Sequence[Born], color: str) -> Spec:
    words = any(isinstance(b.settings[name], str) for b in everyone)

    def value(born: Born) -> Any:
        return born.settings[name] if words else born.number(name)

    y: dict[str, Any] = {"field": "y", "type": "nominal", "title": None}
    if not words:
        values = [value(b) for b in everyone]
        log = min(values) > 0 and max(values) > 5 * min(values)
        y = number_axis("y", "", scale={"type": "log"} if log else {}, axis={"tickCount": 4})
    axis = {"tickMinStep": 1, "format": "d"}
    encoding = {"x": number_axis("x", "generation", axis=axis), "y": y}
    rows = [{"x": b.generation + 1, "y": value(b)} for b in everyone]
    line = [{"x": b.generation + 1, "y": value(b)} for b in path]
    faint = {"type": "circle", "size": 20, "color": "#8d8d97", "aria": False}
    bold = {
        "type": "line",
        "point": {"size": 35, "color": color},
        "strokeWidth": 2,
        "color": color,
        "aria": False,
    }
    layer = [{"data": {"values": rows}, "mark": faint}, {"data": {"values": line}, "mark": bold}]
    return chart(f"{setting_title(name)} by generation", 150, encoding=encoding, layer=layer)


def what_changed(born: Born) -> str:
    """Return a member's mutation in words."""
    if not born.changes:
        return {"none": "nothing", "start": "–", "goes on": "goes on"}.get(
            born.mutation, born.mutation
        )
    return changes_words(born)


def ink_on(color: RGB) -> str:
    """Return black or white, whichever is read better on a colour."""
    return "#000" if is_light(color) else "#fff"


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
