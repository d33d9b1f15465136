"""The charts of reports, as specifications in Vega-Lite; the page gives them its colours.

A specification is plain data, and holds its data. ``vega`` in a browser draws
it (https://vega.github.io/vega-lite/docs/).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from skillweave.reporting.lineage import Lineage, changes_words, number_of, setting_title
from skillweave.runs.manifest import LineageLine

Spec = dict[str, Any]
STEPS = "environment steps"
FAINT = "#8d8d97"
"""The colour of members that did not lead to the winner."""


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


def steps_axis() -> dict[str, Any]:
    """Return the encoding of steps: 200k, 1M."""
    label = "datum.value === 0 ? '0' : format(datum.value, '~s')"
    axis = {"labelExpr": label, "tickCount": 5, "labelOverlap": True}
    return number_axis("x", STEPS, axis=axis, scale={"zero": True, "nice": False})


def generation_axis() -> dict[str, Any]:
    """Return the encoding of a population's generation."""
    return number_axis("x", "generation", axis={"tickMinStep": 1, "format": "d"})


def group_color(
    field: str, names: Sequence[str], colors: Sequence[str], legend: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Return the encoding of a group by its colour; without a legend, the page has one."""
    scale = {"domain": list(names), "range": list(colors)}
    return {"field": field, "type": "nominal", "scale": scale, "legend": legend}


def marks(kind: str, **look: Any) -> Spec:
    """Return marks of a kind; screen readers have the page's tables in their place."""
    return {"type": kind, "aria": False, **look}


def layer(mark: Spec, rows: Sequence[Mapping[str, Any]] | None = None, **encoding: Any) -> Spec:
    """Return marks with their encoding; ``rows`` where they are not the chart's."""
    values = {} if rows is None else {"data": {"values": list(rows)}}
    return values | {"mark": mark, "encoding": encoding}


def tips(*fields: Sequence[str], **rest: Any) -> list[dict[str, Any]]:
    """Return the fields of a chart's tooltip: of each its name, its title and its format."""
    return [dict(zip(("field", "title", "format"), f, strict=False)) | rest for f in fields]


def curve(label: str, color: str) -> Spec:
    """Return a chart of one agent's metric; the page sets its values and its name.

    It shows the nearest point under the pointer, with a box of its values.
    """
    hue = {"value": color}
    select = {"type": "point", "on": "pointerover", "nearest": True, "clear": "pointerout"}
    near = {"name": "near", "select": select | {"encodings": ["x"]}}
    opacity = {"condition": {"param": "near", "empty": False, "value": 1}, "value": 0}
    tooltip = tips(("x", STEPS, ",d"), ("y", "value", ",.4~r"), type="quantitative")
    point = marks("point", filled=True, size=60)
    layers = [
        layer(marks("line", strokeWidth=2, strokeJoin="round"), color=hue),
        {"params": [near]} | layer(point, opacity=opacity, color=hue, tooltip=tooltip),
    ]
    encoding = {"x": steps_axis(), "y": number_axis("y", "", axis={"tickCount": 5})}
    return chart(f"Learning curve of {label}", 190, encoding=encoding, layer=layers)


def choices(skills: Sequence[str], colors: Sequence[str], *, goals: bool = False) -> Spec:
    """Return a chart of decisions over two coordinates; the page sets values and names.

    Args:
        skills: their names.
        colors: of each skill.
        goals: the values have goals, in words.
    """
    shapes = ["circle", "square", "triangle-up", "diamond", "cross", "triangle-down"]
    shape = {"domain": list(skills), "range": [shapes[i % len(shapes)] for i in range(len(skills))]}
    legend = {"orient": "top", "title": None, "symbolOpacity": 1}
    fields = [("what", "chosen"), *((axis, axis, ",.4~r") for axis in "xy")]
    encoding = {
        "x": number_axis("x", "", axis={"tickCount": 8}),
        "y": number_axis("y", ""),
        "color": group_color("what", skills, colors, legend),
        "shape": {"field": "what", "type": "nominal", "scale": shape},
        "tooltip": tips(*fields, *([("goal",)] if goals else [])),
    }
    mark = marks("point", filled=True, size=45, opacity=0.85)
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
    map_ = layer(marks("rect"), rows, **encoding)
    return chart(f"Success of {name} over its goals", 340, **map_)


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
    layers = [
        layer(marks("rect" if parts else "bar", color=hue, opacity=opacity), y=top, y2={"datum": 0})
        for hue, opacity, top in (("#888888", 0.2, y | {"field": "top"}), ("#009e73", 1.0, y))
    ]
    values = [row | {"top": 1} for row in rows]
    text = f"Success of {name} by its goals"
    return chart(text, 240, data={"values": values}, encoding=shared, layer=layers)


def _of_goals() -> list[dict[str, Any]]:
    fields = ("share", "success", ".0%"), ("calls", "calls", ",d")
    return tips(*fields, type="quantitative")


def family_tree(lineage: Lineage, color: str) -> Spec:
    """Return a chart of fitness by generation, each member joined to its parent."""
    path = {(b.generation, b.member) for b in lineage.path(lineage.winner)}
    dots = []
    lines = []
    for key, born in lineage.born.items():
        if born.fitness is None:
            continue
        dot: dict[str, Any] = {"x": born.generation + 1, "y": round(born.fitness, 3)}
        dot |= {"won": key in path, "what": "winner's line" if key in path else "other members"}
        dots.append(dot | {"member": born.member, "how": what_changed(born)})
        parent = lineage.parent(born)
        if parent is not None and parent.fitness is not None:
            lines.append(dot | {"x2": parent.generation + 1, "y2": round(parent.fitness, 3)})
    legend = {"orient": "top", "title": None, "symbolType": "circle"}
    shared = {
        "x": generation_axis(),
        "y": number_axis("y", "fitness: mean return"),
        "color": group_color("what", ("winner's line", "other members"), (color, FAINT), legend),
    }
    fields = ("member",), ("x", "generation"), ("y", "fitness", ",.4~r"), ("how", "changed")

    def if_won(value: float, usual: float) -> Spec:
        return {"condition": {"test": "datum.won", "value": value}, "value": usual}

    ends = {"x2": {"field": "x2"}, "y2": {"field": "y2"}, "strokeWidth": if_won(2.5, 1)}
    dotted = {"size": if_won(70, 25), "tooltip": tips(*fields)}
    layers = [
        layer(marks("rule"), lines, **shared, **ends),
        layer(marks("circle", opacity=1), dots, **shared, **dotted),
    ]
    return chart("Fitness by generation, and the line of the winner", 320, layer=layers)


def setting_path(name: str, lineage: Lineage, color: str) -> Spec:
    """Return a chart of a setting's values by generation."""

    def rows(members: Iterable[LineageLine]) -> list[dict[str, Any]]:
        return [{"x": b.generation + 1, "y": number_of(b, name)} for b in members]

    y: dict[str, Any] = {"field": "y", "type": "nominal", "title": None}
    if (scale := lineage.scale(name)) != "words":
        log = {"type": "log"} if scale == "log" else {}
        y = number_axis("y", "", scale=log, axis={"tickCount": 4})
    bold = marks("line", point={"size": 35, "color": color}, strokeWidth=2, color=color)
    layers = [
        layer(marks("circle", size=20, color=FAINT), rows(lineage.born.values())),
        layer(bold, rows(lineage.path(lineage.winner))),
    ]
    encoding = {"x": generation_axis(), "y": y}
    return chart(f"{setting_title(name)} by generation", 150, encoding=encoding, layer=layers)


def what_changed(born: LineageLine) -> str:
    """Return a member's mutation in words."""
    words = {"none": "nothing", "start": "–"}
    return changes_words(born) or words.get(born.mutation, born.mutation)


def scores(
    names: Sequence[str],
    colors: Sequence[str],
    dots: Sequence[dict[str, Any]],
    bars: Sequence[dict[str, Any]],
    *,
    binary: bool = False,
) -> Spec:
    """Return a chart with a dot for each run, and each group's interquartile mean and interval.

    Args:
        names: of the groups.
        colors: of each group.
        dots: rows of runs.
        bars: rows of groups, with ``low`` and ``high`` where there is an interval.
        binary: returns are 0 or 1, so that their mean is the share of episodes that are solved.
    """
    what, form = ("episodes solved", ".0%") if binary else ("mean return", ",.4~r")
    y: dict[str, Any] = {"field": "group", "type": "nominal", "title": None, "sort": names}
    y["axis"] = {"labelFontSize": 14, "labelFontWeight": "bold"}
    of_group = {"y": y, "color": group_color("group", names, colors)}
    axis: dict[str, Any] = {"tickCount": 8} | ({"format": "%"} if binary else {})
    x = number_axis("x", f"{what} of a run", axis=axis)
    fields = ("x", "interquartile mean", form), ("low", "from", form), ("high", "to", form)
    of_bar = of_group | {"tooltip": tips(("group",), *fields)}
    of_run = tips(("group",), ("seed",), ("x", what, form))
    between = {"x": {"field": "low", "type": "quantitative"}, "x2": {"field": "high"}}
    layers = [
        layer(marks("point", size=50, strokeWidth=1.5), dots, x=x, **of_group, tooltip=of_run),
        layer(marks("tick", thickness=4, size=22), bars, x=x, **of_bar),
    ]
    if any("low" in bar for bar in bars):  # an axis over nothing is warned of
        valid = {"transform": [{"filter": "isValid(datum.low)"}]}
        rule = marks("rule", strokeWidth=5, opacity=0.5)
        layers.insert(0, valid | layer(rule, bars, **between, **of_bar))
    return chart("Scores by group", 50 + 40 * len(names), layer=layers)


def group_curves(label: str, names: Sequence[str], colors: Sequence[str]) -> Spec:
    """Return a chart of an agent's metric, with a line and a band for each group."""
    value = ",.4~r"
    fields = ("y", "value", value), ("lo", "from", value), ("hi", "to", value)
    tooltip = tips(("what", "group"), ("x", STEPS, ",d"), *fields)
    encoding = {"x": steps_axis(), "color": group_color("what", names, colors)}
    band = marks("area", opacity=0.2, tooltip=False)
    dot = marks("point", opacity=0, size=80, filled=True)
    y = number_axis("y", "")
    layers = [
        layer(band, y=number_axis("lo", ""), y2={"field": "hi"}),
        layer(marks("line", strokeWidth=2), y=y),
        layer(dot, y=y, tooltip=tooltip),
    ]
    return chart(f"Learning curves of {label}", 220, encoding=encoding, layer=layers)
