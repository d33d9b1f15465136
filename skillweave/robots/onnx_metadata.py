"""``sw.from_metadata``: the metadata of ONNX files of mjlab and BeyondMimic, and their motion."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave._internal.notices import notice
from skillweave.errors import PolicyError, RunError, needs_extra
from skillweave.policies.core import Array
from skillweave.policies.mapped import NUMBERS
from skillweave.policies.sessions import open_session
from skillweave.policies.timed import LONGEST
from skillweave.policies.untrusted import check_file
from skillweave.robots.read_mapping import ReadMapping, ReadTerm
from skillweave.robots.robot_keys import (
    JointOrder,
    RobotKeys,
    action_places,
    checked_joints,
    ends,
    places_by_name,
    read_robot,
)
from skillweave.robots.terms import ANGLES, KEYS, Term, TermReader, plain
from skillweave.schema import fitted
from skillweave.skills.mapping import Acts, Elapsed, Table

NEEDED = ("joint_names", "default_joint_pos", "action_scale", "observation_names")
"""The fields without which nothing can be mapped."""
GAINS = {"stiffness": "joint_stiffness", "damping": "joint_damping"}
HISTORY = "observation_history_lengths"
NOTED = ("run_path", "command_names", "anchor_body_name", "body_names")
"""Fields that say nothing about a mapping."""
CLOCK = "time_step"
"""The input that is the row of the motion."""
REFERENCE = ("joint_pos", "joint_vel")
"""Outputs that are the motion which the policy sees as its term ``command``."""
DECIMALS = 3
"""The decimals to which exporters round."""
MOST_ROWS = 100_000
"""The most rows of a motion."""


@checked_names
def from_metadata(
    file: str | Path, env: Any, *, names: Mapping[str, Any] | None = None, joints: Any = None
) -> ReadMapping:
    """Read the metadata of an ONNX file of mjlab or BeyondMimic as ``sees`` and ``acts``.

    ```
    read = sw.from_metadata("walk.onnx", Robot)
    print(read)
    walk = sw.from_onnx("walk.onnx", **read, goal=(0.5, 0.0, 0.0))
    ```

    Joints are found by their names. In a file that tracks a motion the term ``command`` is the
    motion in the file, and its input ``time_step`` counts the steps since the skill took over.

    Args:
        file: the ONNX file.
        env: an ``EnvSpec``, a Gymnasium id, or a function that makes an environment.
        names: entries of ``sees`` by the name of a term, where its key has another name, or it has
            none: ``{"base_ang_vel": "imu"}``. Settings with their defaults are the file's: what
            differs from it, a scale of 1 too, is set in the result.
        joints: names of the environment's joints, as the file calls them, in the order of its
            observation and action. None: its attribute ``joint_names``, or names in MuJoCo's model.

    Returns:
        The mapping, which prints where each number is from, and what the file does not say.

    Raises:
        RunError: the file cannot be read, or its metadata have a wrong field.
        DeclarationError: a term is unknown, or an argument is wrong.
        PolicyError: there are no such metadata, or numbers do not fit the environment.
        MissingExtra: the extra 'onnx' is not installed.
    """
    path = Path(file)
    model = _open(path)
    fields = {entry.key: entry.value for entry in model.metadata_props}
    _refuse_others(fields, path.name)
    texts = {
        name: [x.strip() for x in fields[name].split(",")]
        for name in ("joint_names", "observation_names")
    }
    count = len(texts["joint_names"])
    if len(set(texts["joint_names"])) < count:
        raise RunError(f"{path.name}: joint_names has a name twice: {short(fields['joint_names'])}")
    wide = ("default_joint_pos", "action_scale", *(x for x in GAINS.values() if x in fields))
    numbers = {name: _numbers(fields[name], name, count, path.name) for name in wide}
    names = fitted(Mapping[str, Any], names or {}, "from_metadata(): names")
    given = checked_joints(joints, "from_metadata()")
    robot = read_robot(env)
    order, unsaid = _joint_order(texts["joint_names"], numbers, robot, given, path.name)
    action = _action(numbers["action_scale"], robot, order, path.name, unsaid)
    inputs = {entry.name: _size(entry) for entry in model.graph.input}
    observed = next((name for name in inputs if name != CLOCK), "")
    motion = motion_of(model, path, REFERENCE) if CLOCK in inputs else None
    terms = _terms(fields, texts["observation_names"], motion, path.name)
    reader = TermReader(path.name, robot, order, names, action.numbers or 0)
    reader.check_names(terms)
    read = {"": reader.read(terms)}
    _check_size(read[""], terms, inputs[observed], path.name)
    if motion is not None:
        clock = Elapsed(clip=(0.0, len(motion) - 1.0))
        source = {"clip": f"{path.name}: the rows of its motion"}
        read = {observed: read[""], CLOCK: [ReadTerm(CLOCK, clock, 1, source)]}
    if all(round(x, DECIMALS) == x for values in numbers.values() for x in values):
        notice(
            f"{path.name}: its metadata are rounded to {DECIMALS} decimals; where you have the "
            "training's numbers, set them: read['acts'] = dataclasses.replace(read['acts'], ...)"
        )
    gains = {name: order.gains(numbers[key]) for name, key in GAINS.items() if key in numbers}
    unsaid += _unsaid(fields)
    return ReadMapping(path.name, read, action, gains, unsaid)


@checked_names
def reference_motion(file: str | Path, output: str) -> Array:
    """Return the motion that lies in an ONNX file, (T, K) float64: T rows of K numbers.

    ```
    angles = sw.reference_motion("dance.onnx", "joint_pos")
    sees = (sw.Table(angles), ...)
    ```

    The file is run with ``time_step`` 0, 1, 2 and on, for each row of its tables.

    Args:
        file: an ONNX file of mjlab or BeyondMimic, with the input ``time_step``.
        output: the name of the output, "joint_pos" for example.

    Raises:
        RunError: the file cannot be read.
        PolicyError: it has no such input or output, or this is no row of a table.
        MissingExtra: the extra 'onnx' is not installed.
    """
    path = Path(file)
    return motion_of(_open(path), path, (fitted(str, output, "reference_motion(): output"),))


def motion_of(model: Any, path: Path, outputs: Sequence[str]) -> Array:
    """Return outputs of a file by their rows, (rows, numbers of all), as float64.

    Raises:
        PolicyError: it has no such input or output, or this is no row of a table.
    """
    session = open_session(model.SerializeToString(deterministic=True), path.name)
    inputs = {entry.name: entry for entry in session.get_inputs()}
    there = [entry.name for entry in session.get_outputs()]
    if CLOCK not in inputs or (missing := [name for name in outputs if name not in there]):
        lacks = f"input {CLOCK!r}" if CLOCK not in inputs else f"output {missing[0]!r}"
        raise PolicyError(
            f"{path.name} has no {lacks}, so no motion lies in it: it takes {', '.join(inputs)} "
            f"and returns {', '.join(there)}"
        )
    rows = _rows_of(model, path, outputs)
    feeds = {}
    for name, entry in inputs.items():
        shape = [n if isinstance(n, int) else 1 for n in entry.shape]
        feeds[name] = np.zeros(shape, NUMBERS.get(entry.type, np.float32))
    found = []
    for step in range(rows):
        feeds[CLOCK] = np.full_like(feeds[CLOCK], step)
        try:
            values = session.run(list(outputs), feeds)
        except Exception as error:  # onnxruntime's own errors have no common class
            raise PolicyError(f"{path.name}: no row {step:,}: {str(error)[:200]}") from error
        found.append(np.concatenate([np.float64(x).reshape(-1) for x in values]))
    return np.array(found)


def _rows_of(model: Any, path: Path, outputs: Sequence[str]) -> int:
    """Return the rows of the tables from which outputs are gathered.

    Raises:
        PolicyError: an output is no row of a table, or depends on more than the step.
    """
    graph = model.graph
    known = {tensor.name: tuple(tensor.dims) for tensor in graph.initializer}
    made_by = {name: node for node in graph.node for name in node.output}
    for node in graph.node:
        if node.op_type == "Constant" and node.attribute[0].name == "value":
            known[node.output[0]] = tuple(node.attribute[0].t.dims)
    free = {entry.name for entry in graph.input} - known.keys()
    lengths: set[int] = set()
    for output in outputs:
        waiting, done = [output], set[str]()
        gathered = False
        while waiting:
            name = waiting.pop()
            if name in done or name in known:
                continue
            done.add(name)
            node = made_by.get(name)
            if node is None:
                continue
            if node.op_type == "Gather" and len(known.get(node.input[0], ())) > 0:
                gathered = True
                lengths.add(known[node.input[0]][0])
            waiting += node.input
        if others := sorted(done & free - {CLOCK}):
            raise PolicyError(
                f"{path.name}: its output {output!r} depends on {', '.join(others)}, so it is no "
                "motion that lies in the file"
            )
        if not gathered:
            raise PolicyError(
                f"{path.name}: its output {output!r} is no row of a table in the file"
            )
    if len(lengths) > 1 or max(lengths) > MOST_ROWS:
        raise PolicyError(
            f"{path.name}: its outputs {', '.join(outputs)} are of tables with {sorted(lengths)} "
            f"rows; one number of at most {MOST_ROWS:,} is read"
        )
    return lengths.pop()


# The file


def _open(path: Path) -> Any:
    """Return an ONNX model.

    Raises:
        RunError: the file, or one with its weights, cannot be read.
        PolicyError: it is no ONNX model.
    """
    with needs_extra("an ONNX file", "onnx"):
        import onnx
    check_file(path)
    try:
        return onnx.load(str(path))
    except OSError as error:
        raise RunError(f"could not read {path}: {error.strerror or error}") from error
    except Exception as error:  # protobuf's own errors have no common class
        raise PolicyError(f"{path} is no ONNX model: {str(error)[:300]}") from error


def _refuse_others(fields: Mapping[str, str], file: str) -> None:
    """Raise a PolicyError where metadata are missing, or of another exporter."""
    if "dof_names" in fields:
        raise PolicyError(
            f"{file}: its metadata are holosoma's ({', '.join(fields)}), which lack the scale of "
            "actions, the default pose, and names and scales of terms: write sees= and acts= of "
            "from_onnx() yourself"
        )
    if missing := [name for name in NEEDED if not fields.get(name)]:
        has = f"has the metadata {short(', '.join(fields))}" if fields else "has no metadata"
        raise PolicyError(
            f"{file} {has}; {missing[0]} is missing of {', '.join(NEEDED)}, which mjlab and "
            "BeyondMimic write: use from_deploy(), or write sees= and acts= of from_onnx()"
        )


def _numbers(text: str, name: str, count: int, file: str) -> tuple[float, ...]:
    """Return the numbers of a field; one stands for all.

    Raises:
        RunError: one is not finite, or there are too few.
    """
    try:
        values = [float(x) for x in text.split(",")]
    except ValueError:
        values = []
    if not values or not all(map(math.isfinite, values)) or len(values) not in (1, count):
        raise RunError(
            f"{file}: {name} is {short(text)}; it must have {count} finite numbers, one for each "
            "of joint_names"
        )
    return tuple(values * count if len(values) == 1 else values)


def _size(entry: Any) -> int:
    """Return the numbers of an input; 0: unknown."""
    shape = [axis.dim_value for axis in entry.type.tensor_type.shape.dim]
    return math.prod(shape[1:]) if len(shape) > 1 else 0


# The mapping


def _joint_order(
    wanted: Sequence[str],
    numbers: Mapping[str, tuple[float, ...]],
    robot: RobotKeys,
    given: tuple[str, ...],
    file: str,
) -> tuple[JointOrder, list[str]]:
    """Return the file's joints in the environment, and what is assumed of them.

    Raises:
        PolicyError: names of joints do not agree.
    """
    if given and robot.joints and given != robot.joints and set(given) == set(robot.joints):
        raise PolicyError(
            f"joints is {short(list(given), 200)}, but {robot.name} has them in the order "
            f"{short(list(robot.joints), 200)}: leave joints out"
        )
    there = given or robot.joints
    sizes = {n for key, n in robot.sizes.items() if key.rpartition(".")[2] in KEYS[ANGLES]}
    sources = {"offset": f"{file}: default_joint_pos", "places": f"{file}: joint_names"}
    pose = numbers["default_joint_pos"]
    if not given and sizes and len(there) not in sizes:
        there = ()  # the model's joints are not those of the observation
    if not there:
        places = tuple(range(len(wanted)))
        text = f"that the environment's joints are in the file's order ({ends(wanted)})"
        return JointOrder(places, len(wanted), pose, sources), [f"{text}: give joints="]
    places = places_by_name(wanted, there, f"{file}: joint_names", robot.name)
    text = "that the environment's observation and action have joints in the order of its names"
    return JointOrder(places, len(there), pose, sources), [text]


def _action(
    scale: tuple[float, ...], robot: RobotKeys, order: JointOrder, file: str, unsaid: list[str]
) -> ReadTerm:
    """Return the meaning of the outputs."""
    to = action_places(order.places, robot, file, unsaid)
    sources = {"scale": f"{file}: action_scale", "offset": order.sources["offset"]}
    if to is not None:
        sources["to"] = order.sources["places"]
    acts = Acts(to=to, scale=plain(scale), offset=plain(order.pose))
    return ReadTerm("action", acts, len(order.places), sources)


def _terms(
    fields: Mapping[str, str], names: Sequence[str], motion: Array | None, file: str
) -> list[Term]:
    """Return the terms of the policy's input."""
    past = [1] * len(names)
    if HISTORY in fields:
        found = _numbers(fields[HISTORY], HISTORY, len(names), file)
        if any(n != int(n) or not 0 <= n <= LONGEST for n in found):
            raise RunError(
                f"{file}: {HISTORY} is {short(fields[HISTORY])}; it must be whole numbers from 0 "
                f"to {LONGEST:,}"
            )
        past = [max(1, int(n)) for n in found]
    terms = []
    for name, history in zip(names, past, strict=True):
        sources: dict[str, str] = {}
        settings = {} if history == 1 else {"history": history}
        if settings:
            sources["history"] = f"{file}: {HISTORY}"
        entry = None
        if name == "command" and motion is not None:
            entry = Table(motion)
            sources["entry"] = f"{file}: its outputs {' and '.join(REFERENCE)}"
        relative = name in ("joint_pos", "joint_pos_rel")
        terms.append(Term(name, settings, sources, relative=relative, entry=entry))
    return terms


def _check_size(read: Sequence[ReadTerm], terms: Sequence[Term], size: int, file: str) -> None:
    """Raise a PolicyError where the numbers of terms do not make the input."""
    past = {term.name: term.settings.get("history", 1) for term in terms}
    counts = [(term.name, term.numbers, past[term.name]) for term in read]
    if not size or any(n is None for _, n, _ in counts):
        return
    total = sum((n or 0) * history for _, n, history in counts)
    if total != size:
        each = ", ".join(f"{name} {n}{f' x {h}' if h > 1 else ''}" for name, n, h in counts)
        raise PolicyError(
            f"{file} takes {size} numbers, but its terms have {total} ({each}): look at names= "
            "and at the keys of the environment"
        )


def _unsaid(fields: Mapping[str, str]) -> list[str]:
    """Return what metadata do not say."""
    past = "" if HISTORY in fields else ", history 1"
    found = [
        f"scales, clips and history of the terms: here 1, none{past}",
        "that the default pose is subtracted of joint_pos, and added to actions",
        "the seconds of a step",
        "that the environment takes targets of joint angles, with the gains above, and has the "
        "training's armature and limits of torque",
    ]
    known = {*NEEDED, *GAINS.values(), *NOTED, HISTORY}
    if others := [name for name in fields if name not in known]:
        found.append(f"fields that are not read: {short(', '.join(others))}")
    if missing := [key for key in GAINS.values() if key not in fields]:
        found.append(f"gains: {', '.join(missing)}")
    return found
