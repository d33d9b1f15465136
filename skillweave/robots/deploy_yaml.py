"""``sw.from_deploy``: Unitree's deploy.yaml, of unitree_rl_lab and unitree_rl_mjlab."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave._internal.notices import notice
from skillweave.errors import DeclarationError, PolicyError, RunError, needs_extra
from skillweave.policies.untrusted import read_file
from skillweave.robots.read_mapping import ReadMapping, ReadTerm
from skillweave.robots.robot_keys import (
    JointOrder,
    Places,
    RobotKeys,
    action_places,
    checked_joints,
    ends,
    places_by_name,
    read_robot,
)
from skillweave.robots.terms import COMMANDS, Term, TermReader, plain
from skillweave.schema import Count, Positive, fit, fitted
from skillweave.skills.mapping import Acts, Elapsed, Goal

MOST, MOST_VALUES = 2**20, 100_000
"""The most bytes of a file, and values in it."""
YAML = "tag:yaml.org,2002:"
SLICE = f"{YAML}python/object/apply:builtins.slice"
"""The tag with which Isaac Lab writes "all joints": slice(None)."""
RANGES = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
"""The numbers of a command, in their order."""
FLAGS = ("scale_first", "use_gym_history")
"""Settings that stand beside the terms of an observation."""
ROUNDED = 1e-6
"""The relative difference of ranges that are the same but for rounding."""
Pair = tuple[float, float]


class _Term(TypedDict):
    scale: NotRequired[tuple[float, ...] | float | None]
    clip: NotRequired[Pair | None]
    history_length: NotRequired[Count | None]
    params: NotRequired[dict[str, Any] | None]


class _Action(TypedDict):
    scale: NotRequired[tuple[float, ...] | float | None]
    offset: NotRequired[tuple[float, ...] | float | None]
    clip: NotRequired[tuple[Pair, ...] | None]
    joint_ids: NotRequired[tuple[Count, ...] | str | None]


class _Deploy(TypedDict):
    joint_ids_map: tuple[Count, ...]
    step_dt: Positive
    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    default_joint_pos: tuple[float, ...]
    commands: NotRequired[dict[str, Any] | None]
    actions: dict[str, _Action]
    observations: dict[str, Any]


@checked_names
def from_deploy(
    file: str | Path, env: Any, *, names: Mapping[str, Any] | None = None, joints: Any = None
) -> ReadMapping:
    """Read Unitree's deploy.yaml as the mapping of a policy: ``sees`` and ``acts``.

    ```
    read = sw.from_deploy("deploy.yaml", Robot)
    print(read)
    walk = sw.from_onnx("policy.onnx", **read, goal=(0.5, 0.0, 0.0))
    ```

    Terms with usual names are found among the keys of the environment's observation. Scales, clips,
    histories, the default pose and the order of joints are the file's. Nothing in it is run.

    Args:
        file: the file, of unitree_rl_lab or unitree_rl_mjlab.
        env: an ``EnvSpec``, a Gymnasium id, or a function that makes an environment.
        names: entries of ``sees`` by the name of a term, where its key has another name, or it has
            none: ``{"base_ang_vel": "imu"}``. Settings with their defaults are the file's: what
            differs from it, a scale of 1 too, is set in the result.
        joints: names of the joints in the order of Unitree's SDK, to which the file's
            ``joint_ids_map`` leads; the environment has names in its attribute ``joint_names``, or
            in MuJoCo's model. None: the environment's joints are in the SDK's order.

    Returns:
        The mapping, which prints where each number is from, and what the file does not say.

    Raises:
        RunError: the file cannot be read, or is another one; the message names the field.
        DeclarationError: a term is unknown, or an argument is wrong.
        PolicyError: its numbers do not fit the environment.
        MissingExtra: the extra 'robots' is not installed.
    """
    path = Path(file)
    data = _load(path)
    _refuse_others(data, path.name)
    deploy = fit(_Deploy, data, path.name)
    names = fitted(Mapping[str, Any], names or {}, "from_deploy(): names")
    sdk = checked_joints(joints, "from_deploy()")
    robot = read_robot(env)
    order, motors = _joint_order(deploy, robot, sdk, path.name)
    unsaid: list[str] = []
    action = _action(deploy, robot, order, path.name, unsaid)
    reader = TermReader(path.name, robot, order, names, action.numbers or 0)
    groups = {
        name: _terms(deploy, observed, where, path.name, unsaid)
        for name, where, observed in _groups(deploy["observations"], path.name)
    }
    every = [term for terms in groups.values() for term in terms]
    reader.check_names(every)
    read = {name: reader.read(terms) for name, terms in groups.items()}
    gains = {
        name: order.gains([deploy[name][i] for i in motors]) for name in ("stiffness", "damping")
    }
    unsaid = [*_unsaid(deploy, robot, sdk, every), *unsaid]
    return ReadMapping(path.name, read, action, gains, unsaid)


# The file


def _load(path: Path) -> dict[str, Any]:
    """Return a file's mapping, of plain values alone.

    Raises:
        RunError: it is no YAML, no mapping, or has a tag or a name twice.
    """
    with needs_extra("a deploy.yaml", "robots"):
        import yaml
    try:
        node = yaml.compose(read_file(path, MOST), Loader=yaml.SafeLoader)
        data = _value(node, path.name, "", iter(range(MOST_VALUES))) if node is not None else None
    except yaml.YAMLError as error:
        raise RunError(f"{path.name} is no YAML: {' '.join(str(error).split())[:300]}") from error
    except (RecursionError, ValueError) as error:
        raise RunError(f"{path.name} is damaged: {str(error)[:200]}") from error
    if not isinstance(data, dict) or not all(isinstance(key, str) for key in data):
        raise RunError(f"{path.name} is {short(data)}; a deploy.yaml is a mapping of names")
    return data


def _value(node: Any, file: str, at: str, left: Iterator[int]) -> Any:
    """Return the plain value of a node of YAML.

    Args:
        at: its field.
        left: has an item for each value that may follow, as aliases may repeat lists of lists.
    """
    import yaml

    if next(left, None) is None:
        raise RunError(f"{file} has more than {MOST_VALUES:,} values: damaged, or another file")
    kind = node.tag.removeprefix(YAML)
    found: Any = None
    if kind == "map" and isinstance(node, yaml.MappingNode):
        found = {}
        for name, inner in node.value:
            key = _value(name, file, at, left)
            if not isinstance(key, str | int | float | None) or key in found:
                raise RunError(f"{file}: {at or 'the file'} has the name {short(key)} twice")
            found[key] = _value(inner, file, f"{at}.{key}" if at else str(key), left)
    elif kind == "seq" and isinstance(node, yaml.SequenceNode):
        found = [_value(x, file, f"{at}[{i}]", left) for i, x in enumerate(node.value)]
    elif isinstance(node, yaml.ScalarNode) and kind in ("null", "bool", "int", "float", "str"):
        found = yaml.constructor.SafeConstructor().construct_object(node)
    elif node.tag == SLICE and all(x.tag == f"{YAML}null" for x in node.value):
        found = "all"
    else:
        raise RunError(
            f"{file}: {at or 'the file'} has the tag {short(node.tag)}; plain values are read, "
            "and slice(None), nothing else"
        )
    return found


def _refuse_others(data: Mapping[str, Any], file: str) -> None:
    """Raise a RunError where a file is of another format, which it names."""
    inner = next((x for x in data.values() if isinstance(x, Mapping)), {}) if len(data) == 1 else {}
    why = None
    if "models" in data and "pipeline" in data:
        why = "has models and pipeline, so it is a LEAPP file"
    elif "articulations" in data or isinstance(data.get("actions"), list):
        why = "has lists of actions and articulations, so it is an IO descriptor of Isaac Lab"
    elif "num_obs" in data and "default_angles" in data:
        why = "has num_obs and default_angles, so it is a configuration of unitree_rl_gym, which "
        why += "says neither the terms of the observation nor names of joints"
    elif {"num_of_dofs", "joint_mapping"} & set(inner):
        why = "has num_of_dofs and joint_mapping under one name, so it is a configuration of rl_sar"
    elif "schema_version" in data and "model_api" in data:
        why = "has schema_version and model_api, so it is a manifest of MicroDuck"
    if why:
        raise RunError(
            f"{file} {why}; from_deploy() reads the deploy.yaml of unitree_rl_lab and "
            "unitree_rl_mjlab: write sees= and acts= of from_onnx() yourself"
        )


# Joints and actions


def _joint_order(
    deploy: Any, robot: RobotKeys, sdk: tuple[str, ...], file: str
) -> tuple[JointOrder, Places]:
    """Return the policy's joints in the environment, and in the SDK's order.

    Raises:
        RunError: lists of the file have different lengths, or a joint is named twice.
        PolicyError: the environment lacks names of joints, or one of them.
    """
    motors = deploy["joint_ids_map"]
    count = len(deploy["stiffness"])
    lengths = {name: len(deploy[name]) for name in ("joint_ids_map", "default_joint_pos")}
    if len(set(lengths.values())) > 1 or len(deploy["damping"]) != count or not motors:
        raise RunError(
            f"{file}: joint_ids_map has {len(motors)} numbers, default_joint_pos "
            f"{lengths['default_joint_pos']}, stiffness {count} and damping "
            f"{len(deploy['damping'])}; the first two and the last two must agree"
        )
    if len(set(motors)) < len(motors) or max(motors) >= count:
        raise RunError(
            f"{file}: joint_ids_map is {short(list(motors))}; it must have each of the "
            f"{count} joints of stiffness once at most"
        )
    sources = {"places": f"{file}: joint_ids_map", "offset": f"{file}: default_joint_pos"}
    pose = deploy["default_joint_pos"]
    if not sdk:
        return JointOrder(motors, count, pose, sources), motors
    if len(sdk) != count:
        raise DeclarationError(
            f"from_deploy(): joints has {len(sdk)} names, but {file} has {count} of stiffness"
        )
    if not robot.joints:
        raise PolicyError(
            f"joints is given, but {robot.name} has no names of joints: give it an attribute "
            "joint_names, a list in the order of its observation and action"
        )
    there = places_by_name(sdk, robot.joints, "joints", robot.name)
    sources["places"] += " and joints="
    return JointOrder(tuple(there[i] for i in motors), len(robot.joints), pose, sources), motors


def _action(
    deploy: Any, robot: RobotKeys, order: JointOrder, file: str, unsaid: list[str]
) -> ReadTerm:
    """Return the meaning of the outputs; what it cannot hold goes into ``unsaid``."""
    actions = deploy["actions"]
    if set(actions) != {"JointPositionAction"}:
        raise RunError(
            f"{file}: actions has {', '.join(actions) or 'nothing'}; one JointPositionAction is "
            "read, nothing else: write sees= and acts= of from_onnx() yourself"
        )
    where = "actions.JointPositionAction"
    action = actions["JointPositionAction"]
    ids = _ids(action.get("joint_ids"), len(order.places), f"{where}.joint_ids", file)
    places = tuple(order.places[i] for i in ids)
    sources = {"to": order.sources["places"]}
    settings: dict[str, Any] = {}
    for name, default in (("scale", 1.0), ("offset", 0.0)):
        value = action.get(name)
        values = (value,) if isinstance(value, float) else value
        if values is not None and len(values) not in (1, len(ids)):
            raise RunError(
                f"{file}: {where}.{name} has {len(values)} numbers for {len(ids)} outputs"
            )
        settings[name] = default if values is None else plain(values)
        sources[name] = f"{file}: {where}.{name}"
    if (ranges := action.get("clip")) is not None:
        settings["clip"], lacks = _output_clip(ranges, settings["scale"], settings["offset"], ids)
        sources["clip"] = f"{file}: {where}.clip, before scale and offset"
        if lacks:
            _leave_out(f"{where}.clip", lacks, "the limits of the environment's action", unsaid)
        else:
            unsaid.append("that the last action is clipped, too: in training it is not")
    to = action_places(places, robot, file, unsaid)
    if to is None:
        del sources["to"]
    return ReadTerm("action", Acts(to=to, **settings), len(places), sources)


def _ids(ids: Any, count: int, where: str, file: str) -> Places:
    """Return chosen joints of the policy; None and "all": every one."""
    if ids is None or ids == "all":
        return tuple(range(count))
    if isinstance(ids, str) or not ids or len(set(ids)) < len(ids) or max(ids) >= count:
        raise RunError(f"{file}: {where} is {short(ids)}; it must be different joints of {count}")
    return tuple(ids)


def _output_clip(ranges: Any, scale: Any, offset: Any, ids: Places) -> tuple[Pair | None, str]:
    """Return the range of outputs before scale and offset, and why there is none."""
    n = len(ids)
    if len(ranges) not in (1, n):
        return None, f"it has {len(ranges)} ranges for {n} outputs"
    wide = [x if isinstance(x, tuple) else (x,) * n for x in (scale, offset)]
    if 0.0 in wide[0]:
        return None, "a scale is 0"
    found = []
    for i, (factor, shift) in enumerate(zip(*wide, strict=True)):
        ends = [(end - shift) / factor for end in ranges[i if len(ranges) == n else 0]]
        found.append((min(ends), max(ends)))
    if np.allclose(found, found[0], ROUNDED, ROUNDED):
        return found[0], ""
    return None, "outputs have different ranges before scale and offset"


def _leave_out(where: str, why: str, instead: str, unsaid: list[str]) -> None:
    """Give a notice of what is not in the mapping, and list it."""
    unsaid.append(f"{where}, which is left out, as {why}: use {instead}")
    notice(f"from_deploy() leaves out {where}, as {why}: use {instead}")


# Observations


def _groups(observations: Mapping[str, Any], file: str) -> list[tuple[str, str, Any]]:
    """Return the inputs of the policy: name, field and terms of each; "": the only one."""
    terms = {name: x for name, x in observations.items() if name not in FLAGS}
    if not terms or not all(isinstance(x, Mapping) for x in terms.values()):
        raise RunError(f"{file}: observations is {short(dict(observations))}; it must have terms")
    own = set(_Term.__annotations__)
    if any(set(term) & own or not term for term in terms.values()):
        return [("", "observations", observations)]
    return [(name, f"observations.{name}", x) for name, x in terms.items()]


def _terms(
    deploy: Any, observed: Mapping[str, Any], where: str, file: str, unsaid: list[str]
) -> list[Term]:
    """Return the terms of an input."""
    flags = fit(dict[str, bool], {k: observed.get(k, False) for k in FLAGS}, file, where)
    found = []
    for name, data in observed.items():
        if name in FLAGS:
            continue
        field = f"{where}.{name}"
        term = fit(_Term, data, file, field)
        params = term.get("params") or {}
        scale = term.get("scale")
        settings: dict[str, Any] = {"scale": 1.0 if scale is None else plain(scale)}
        sources = {} if scale is None else {"scale": f"{file}: {field}.scale"}
        if (clip := term.get("clip")) is not None:
            settings["clip"] = _input_clip(clip, settings["scale"], flags["scale_first"])
            sources["clip"] = f"{file}: {field}.clip, after scale"
            if settings["clip"] is None:
                why = "its numbers have different scales, and a Part has one clip"
                _leave_out(f"{field}.clip", why, "a function of observations in names", unsaid)
        if (past := term.get("history_length") or 1) > 1:
            settings["history"] = past
            settings["layout"] = "step" if flags["use_gym_history"] else "term"
            sources["history"] = f"{file}: {field}.history_length"
        entry: Any = None
        if name in COMMANDS and not _of_motion(params):
            entry = _goal(deploy, sources, file)
        elif name == "gait_phase" and _is_number(params.get("period")):
            period = params["period"] / deploy["step_dt"]
            sources["period"] = f"{file}: {field}.params.period and step_dt"
            entry = Elapsed(period=period, wave="sin"), Elapsed(period=period, wave="cos")
            unsaid.append("whether the clock of gait_phase starts at 0 or a step later: here at 0")
        chosen = params.get("asset_cfg")
        ids = chosen.get("joint_ids") if isinstance(chosen, Mapping) else None
        total = len(deploy["joint_ids_map"])
        joints = None if ids in (None, "all") else _ids(_whole(ids), total, f"{field}.params", file)
        numbers = len(scale) if isinstance(scale, tuple) else None
        relative = name == "joint_pos_rel"
        if name == "joint_pos":
            unsaid.append("whether joint_pos is less the default pose: here it is not")
        found.append(Term(name, settings, sources, numbers, joints, relative, entry))
    return found


def _of_motion(params: Mapping[str, Any]) -> bool:
    return "motion" in str(params.get("command_name", ""))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < 1e6


def _whole(ids: Any) -> Any:
    good = isinstance(ids, list) and all(type(x) is int and x >= 0 for x in ids)
    return tuple(ids) if good else str(ids)


def _input_clip(clip: Pair, scale: Any, scale_first: bool) -> Pair | None:
    """Return a range after scaling, of one before it; None: there are several."""
    if scale_first:
        return clip
    if isinstance(scale, tuple):
        return None
    low, high = sorted(end * scale for end in clip)
    return low, high


def _goal(deploy: Any, sources: dict[str, str], file: str) -> Goal:
    """Return the place of the command, with its ranges."""
    command = (deploy.get("commands") or {}).get("base_velocity")
    ranges = command.get("ranges") if isinstance(command, Mapping) else None
    if not isinstance(ranges, Mapping) or not all(ranges.get(name) for name in RANGES):
        return Goal()
    where = "commands.base_velocity.ranges"
    pairs = [fit(Pair, ranges[name], file, f"{where}.{name}") for name in RANGES]
    sources |= {"low": f"{file}: {where}", "high": f"{file}: {where}"}
    low, high = (tuple(end) for end in zip(*pairs, strict=True))
    return Goal(low=low, high=high)


def _unsaid(deploy: Any, robot: RobotKeys, sdk: tuple[str, ...], terms: list[Term]) -> list[str]:
    """Return what no deploy.yaml says, beside what was noted while it was read."""
    names = f" ({ends(robot.joints)})" if robot.joints else ""
    found = [
        f"that a step of the environment lasts {deploy['step_dt']:g} s, the file's step_dt",
        "that the environment takes targets of joint angles, with the gains above, and has the "
        "training's armature and limits of torque",
        "in which frame velocities and gravity are: the file's policy takes the body's",
    ]
    if not sdk:
        order = "in the order of Unitree's SDK: give joints= where they are not"
        found.insert(0, f"that the environment's joints{names} are {order}")
    if any("history" in term.settings for term in terms):
        found.append("what the history holds before the first step: here its values at entry")
    if any(isinstance(term.entry, Goal) for term in terms):
        found.append(
            "whether a command out of its ranges is clipped: here one of numbers is refused"
        )
    return found
