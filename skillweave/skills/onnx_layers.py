"""A plain network in an ONNX file: its layers, and the same file with other weights.

A plain network has linear layers with one kind of nonlinearity between them; before the first one
constants may normalise the input, after the last one ``Split`` may take a part, and ``Tanh`` may
bound it. ``read_network`` finds it on the way from an input to an output, and ``rewritten`` puts
learnt layers in the place of the old ones. All else in the file stays as it is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from skillweave._internal.messages import shortened, suggest
from skillweave.errors import PolicyError, needs_extra
from skillweave.policies.core import Array
from skillweave.skills.learnable import Layers

SIMPLE = {"Relu": "relu", "Tanh": "tanh", "Elu": "elu", "Gelu": "gelu", "Swish": "silu"}
"""Operators that are a nonlinearity, and its name in networks here."""
BY_CONSTANTS = ("Sub", "Div", "Mul", "Add")
"""Operators that normalise the input, by a constant."""
SAME = ("Identity", "Flatten", "Dropout")
"""Operators that leave numbers as they are."""
KNOWN = (*SIMPLE, *BY_CONSTANTS, *SAME, "Gemm", "MatMul", "Sigmoid", "Erf", "Split")
"""Operators that may be on the way from the observation to the action."""
ADVICE = (
    "only linear layers with one kind of nonlinearity between them (Relu, Tanh, Elu, SiLU, Gelu), "
    "a normalisation of the input by constants and a last Tanh are known. Let it act as it is "
    "(without learn=True), or learn a correction: policy = Residual(from_onnx(...))"
)
"""Ends messages about networks of another kind."""


@dataclass(frozen=True, eq=False)
class _Step:
    """An operator between the input and the output, or several that are one."""

    kind: str
    """"linear", "activation", "constant" or "split"."""
    node: Any
    """The node; of a linear layer the one with the weights."""
    name: str = ""
    """Of an activation, its name in networks here."""
    value: Array | None = None
    """Of an operator with a constant, the constant."""
    bias: tuple[Any, int] | None = None
    """The node and the number of its input that is a layer's bias; None: it has none."""


@dataclass(frozen=True, eq=False)
class FoundNetwork:
    """A plain network that was found in an ONNX model."""

    layers: Layers
    """Its layers; of the last one the part that ``Split`` takes."""
    offset: Array
    """(in,) what is subtracted from the input first."""
    scale: Array
    """(in,) the factor of the input after that."""
    squashes: bool
    """It ends in ``Tanh``."""
    input: str
    """The name of its input."""
    shape: tuple[int | None, ...]
    """The shape of the input for one environment; None: any number."""
    output: str
    """The name of its output."""

    @property
    def normalizes(self) -> bool:
        """Return whether the input is normalised."""
        return bool(self.offset.any() or (self.scale != 1.0).any())


def read_network(data: bytes, output: str, who: str) -> FoundNetwork:
    """Return the plain network that computes an output of an ONNX model.

    Args:
        data: the model.
        output: the name of the output.
        who: begins messages.

    Raises:
        PolicyError: the network is of another kind; the message names the operator.
    """
    return _Graph(data, output, who).network()


def rewritten(data: bytes, output: str, layers: Layers, who: str) -> bytes:
    """Return an ONNX model with these layers in the place of those before its ``output``.

    Names, shapes, types, other outputs and metadata stay as they are. Weights that another part of
    the graph uses, too, stay there, and the network gets its own.

    Raises:
        PolicyError: the network is of another kind, or has layers of other sizes.
    """
    graph = _Graph(data, output, who)
    old = graph.network().layers
    shapes = [[w.shape for w in one.weights] for one in (old, layers)]
    if shapes[0] != shapes[1]:
        raise PolicyError(f"{who} has layers of {shapes[0]}, but {shapes[1]} were learnt")
    graph.write(layers)
    content: bytes = graph.model.SerializeToString(deterministic=True)
    return content


class _Graph:
    """An ONNX model, read as a plain network before one output; see ``read_network``."""

    def __init__(self, data: bytes, output: str, who: str) -> None:
        with needs_extra("an ONNX file", "onnx"):
            import onnx
            import onnx.numpy_helper
        self._onnx = onnx
        self.model = onnx.load_from_string(data)
        self.graph = self.model.graph
        self.who = who
        self.output = output
        self._made_by = {name: node for node in self.graph.node for name in node.output if name}
        self._stored = {tensor.name: tensor for tensor in self.graph.initializer}
        outputs = [x.name for x in self.graph.output]
        if output not in outputs:
            raise PolicyError(f"{who} has no output {output!r}{suggest(output, outputs)}")
        self._uses = Counter(_read(self.graph))
        self._uses.update(outputs)
        inputs = {x.name: x for x in self.graph.input if x.name not in self._stored}
        moving = set(inputs)
        """Names of what is no constant."""
        for node in self.graph.node:
            if moving.intersection(node.input):
                moving.update(node.output)
        self._moving = moving
        self._inputs = inputs

    def network(self) -> FoundNetwork:
        """Return the network before the output."""
        nodes, found = self._way()
        names = [node.op_type for node in nodes]
        if unknown := list(dict.fromkeys(name for name in names if name not in KNOWN)):
            many = "s" if len(unknown) > 1 else ""
            self._refuse(f"it has the operator{many} {', '.join(unknown)}")
        if len(found) != 1:
            inputs = ", ".join(found) or "none"
            self._refuse(f"its output {self.output!r} depends on the inputs {inputs}, not on one")
        source = found[0]
        steps = self._steps(source)
        order = ", ".join(names)
        layers = [step for step in steps if step.kind == "linear"]
        kinds = "".join(
            {"linear": "L", "activation": "A", "constant": "C"}.get(s.kind, "S") for s in steps
        )
        before = len(kinds) - len(kinds.lstrip("C"))
        rest = kinds[before:]
        squashes = rest.endswith("A") and steps[-1].node.op_type == "Tanh"
        rest = rest[:-1] if squashes else rest
        split = steps[before + len(rest) - 1] if rest.endswith("S") else None
        rest = rest.removesuffix("S")
        if not rest or rest != "LA" * (len(layers) - 1) + "L":
            self._refuse(f"its operators are {shortened(order, 300)}, in this order")
        between = [step for step in steps[before : before + len(rest)] if step.kind == "activation"]
        if len(kinds_of := list(dict.fromkeys(step.name for step in between))) > 1:
            self._refuse(f"it has the nonlinearities {' and '.join(kinds_of)}")
        numbers = [self._numbers(step) for step in layers]
        weights, biases = [x for x, _ in numbers], [x for _, x in numbers]
        if any(a.shape[1] != b.shape[0] for a, b in pairwise(weights)):
            self._refuse("its layers have sizes that do not follow each other")
        self._layers = layers
        self._part = slice(None)
        if split is not None:
            self._part = self._taken(split, weights[-1].shape[1])
        size = weights[0].shape[0]
        offset, scale = np.zeros(size), np.ones(size)
        for step in steps[:before]:
            offset, scale = self._normalized(step, offset, scale, size)
        arrays = (*weights, *biases, offset, scale)
        if not all(np.isfinite(x).all() for x in arrays):
            self._refuse("its weights hold NaN or infinity", known=False)
        weights[-1], biases[-1] = weights[-1][:, self._part], biases[-1][self._part]
        activation = kinds_of[0] if kinds_of else "tanh"
        of = Layers(tuple(weights), tuple(biases), activation)
        kind = self._inputs[source].type.tensor_type
        shape = tuple(d.dim_value or None for d in kind.shape.dim)[1:]
        return FoundNetwork(of, offset, scale, squashes, source, shape or (size,), self.output)

    def _refuse(self, found: str, *, known: bool = True) -> None:
        raise PolicyError(
            f"{self.who} cannot learn on: {found}" + (f", and {ADVICE}" if known else "")
        )

    # The way from the input to the output

    def _way(self) -> tuple[list[Any], list[str]]:
        """Return the nodes between inputs and the output, in order, and these inputs."""
        wanted = {self.output}
        nodes: list[Any] = []
        for node in reversed(self.graph.node):
            if wanted.intersection(node.output) and self._moving.intersection(node.output):
                nodes.append(node)
                wanted.update(name for name in node.input if name in self._moving)
        return nodes[::-1], [name for name in self._inputs if name in wanted]

    def _steps(self, source: str) -> list[_Step]:
        """Return the operators between the input and the output, in the order of acting."""
        name = self.output
        steps: list[_Step] = []
        while name != source:
            step, name = self._before(name)
            if step is not None:
                steps.append(step)
        return steps[::-1]

    def _before(self, name: str) -> tuple[_Step | None, str]:
        """Return the operator that makes a tensor, and the name of the tensor before it."""
        node = self._made_by[name]
        kind = node.op_type
        moving = [x for x in node.input if x in self._moving]
        first = node.input[0]
        if kind in SAME:
            if kind == "Flatten" and self._attributes(node).get("axis", 1) != 1:
                self._refuse("its Flatten joins the axis of environments")
            return None, first
        if kind == "Split":
            return _Step("split", node, name), first
        if kind in SIMPLE:
            given = self._attributes(node)
            alpha, how = given.get("alpha", 1.0), given.get("approximate", b"none")
            if alpha != 1.0 or how != b"none":
                self._refuse(f"its {kind} has another form than networks here have it")
            return _Step("activation", node, SIMPLE[kind]), first
        if kind in ("Gemm", "MatMul"):
            if moving != [first] or self._constant(node.input[1]) is None:
                self._refuse(f"its {kind} multiplies by something that is no constant")
            bias = (node, 2) if kind == "Gemm" and len(node.input) > 2 and node.input[2] else None
            return _Step("linear", node, bias=bias), first
        if kind == "Mul" and (found := self._product(name)) is not None:
            return _Step("activation", node, found[0]), found[1]
        if len(moving) == 1 and len(node.input) == 2:
            at = 1 if first in self._moving else 0
            layer = self._made_by.get(moving[0])
            if kind == "Add" and layer is not None and layer.op_type in ("Gemm", "MatMul"):
                step, before = self._before(moving[0])
                if step is not None and step.bias is None:
                    return replace(step, bias=(node, at)), before
            value = self._constant(node.input[at])
            if value is not None and (at == 1 or kind in ("Add", "Mul")):
                return _Step("constant", node, value=value), moving[0]
        self._refuse(f"its {kind} is used in another way")
        raise AssertionError

    def _product(self, name: str) -> tuple[str, str] | None:
        """Return the nonlinearity that is a product, SiLU or Gelu, and the name of its input."""
        constant, factors = 1.0, [name]
        while any(self._op(x) == "Mul" for x in factors):
            at = next(i for i, x in enumerate(factors) if self._op(x) == "Mul")
            for x in self._made_by[factors.pop(at)].input:
                value = self._constant(x)
                if value is None:
                    factors.append(x)
                elif value.size == 1:
                    constant *= float(value.reshape(()))
                else:
                    return None
        if len(factors) != 2:
            return None
        for x, gate in (factors, factors[::-1]):
            if self._op(gate) == "Sigmoid" and self._made_by[gate].input[0] == x:
                return ("silu", x) if constant == 1.0 else None
            if np.isclose(constant, 0.5) and self._is_erf_gate(gate, x):
                return "gelu", x
        return None

    def _is_erf_gate(self, name: str, x: str) -> bool:
        """Return whether a tensor is ``1 + erf(x / sqrt(2))``."""
        inner = self._with_constant(name, "Add", 1.0)
        if inner is None or self._op(inner) != "Erf":
            return False
        inner = self._made_by[inner].input[0]
        root = float(np.sqrt(2.0))
        return x in (
            self._with_constant(inner, "Div", root),
            self._with_constant(inner, "Mul", 1.0 / root),
        )

    def _with_constant(self, name: str, kind: str, value: float) -> str | None:
        """Return the other input of an operator with one constant number; None: it is another."""
        if self._op(name) != kind:
            return None
        names = list(self._made_by[name].input)
        for other, given in (names, names[::-1] if kind != "Div" else names):
            found = self._constant(given)
            if (
                found is not None
                and found.size == 1
                and np.isclose(float(found.reshape(())), value)
            ):
                return str(other)
        return None

    def _op(self, name: str) -> str:
        node = self._made_by.get(name)
        return "" if node is None or name not in self._moving else str(node.op_type)

    # Numbers

    def _attributes(self, node: Any) -> dict[str, Any]:
        return {x.name: self._onnx.helper.get_attribute_value(x) for x in node.attribute}

    def _root(self, name: str) -> tuple[str, bool, bool]:
        """Return the constant that a name leads to, whether it is transposed, and used once."""
        turned, alone = False, self._uses[name] == 1
        while (node := self._made_by.get(name)) is not None and (
            node.op_type == "Identity" or self._is_transpose(node)
        ):
            turned ^= node.op_type == "Transpose"
            name = node.input[0]
            alone &= self._uses[name] == 1
        return name, turned, alone

    def _is_transpose(self, node: Any) -> bool:
        perm = self._attributes(node).get("perm", [1, 0])
        return node.op_type == "Transpose" and list(perm) == [1, 0]

    def _constant(self, name: str) -> Array | None:
        """Return the numbers of a constant, float64; None: it is none."""
        if name in self._moving:
            return None
        root, turned, _ = self._root(name)
        array: Any = None
        if root in self._stored:
            array = self._onnx.numpy_helper.to_array(self._stored[root])
        elif (node := self._made_by.get(root)) is not None and node.op_type == "Constant":
            value = self._onnx.helper.get_attribute_value(node.attribute[0])
            is_tensor = node.attribute[0].name == "value"
            array = self._onnx.numpy_helper.to_array(value) if is_tensor else np.asarray(value)
        if array is None or array.dtype.kind not in "fiu":
            return None
        numbers: Array = np.asarray(array, np.float64)
        return numbers.T if turned else numbers

    def _numbers(self, step: _Step) -> tuple[Array, Array]:
        """Return the weights (in, out) and the bias (out,) of a linear layer."""
        node = step.node
        given = self._attributes(node)
        weight = self._constant(node.input[1])
        assert weight is not None
        if weight.ndim != 2 or given.get("transA", 0):
            self._refuse(f"its {node.op_type} is no layer of a batch")
        weight = (weight.T if given.get("transB", 0) else weight) * given.get("alpha", 1.0)
        bias = np.zeros(weight.shape[1])
        if step.bias is not None:
            adder, at = step.bias
            value = self._constant(adder.input[at])
            if value is None or value.size not in (1, bias.size):
                self._refuse(f"its {adder.op_type} adds something that is no constant of a layer")
            assert value is not None
            bias = bias + value.reshape(-1) * (given.get("beta", 1.0) if adder is node else 1.0)
        return weight, bias

    def _normalized(
        self, step: _Step, offset: Array, scale: Array, size: int
    ) -> tuple[Array, Array]:
        """Return offset and scale of the input, ``(x - offset) * scale``, after one operator."""
        value = step.value
        assert value is not None
        if value.size not in (1, size):
            self._refuse(f"its {step.node.op_type} changes the shape of the input")
        value = np.broadcast_to(value.reshape(-1), (size,))
        with np.errstate(all="ignore"):
            if step.node.op_type in ("Sub", "Add"):
                sign = 1.0 if step.node.op_type == "Sub" else -1.0
                return offset + sign * value / scale, scale
            return offset, scale * value if step.node.op_type == "Mul" else scale / value

    def _taken(self, step: _Step, width: int) -> slice:
        """Return the part of the last layer that ``Split`` takes."""
        node = step.node
        given = self._attributes(node)
        count = len(node.output)
        sizes = given.get("split")
        if len(node.input) > 1 and (value := self._constant(node.input[1])) is not None:
            sizes = value.astype(int).tolist()
        each = -(-width // count)
        sizes = sizes or [min(each, width - i * each) for i in range(count)]
        if given.get("axis", 0) not in (-1, 1) or sum(sizes) != width:
            self._refuse("its Split is not one of the last layer's outputs")
        at = list(node.output).index(step.name)
        first = sum(sizes[:at])
        return slice(first, first + sizes[at])

    # Writing

    def write(self, layers: Layers) -> None:
        """Write layers in the place of those that ``network`` has found."""
        last = len(layers.weights) - 1
        for i, (step, weight, bias) in enumerate(
            zip(self._layers, layers.weights, layers.biases, strict=True)
        ):
            if i == last:
                whole = self._numbers(step)
                whole[0][:, self._part], whole[1][self._part] = weight, bias
                weight, bias = whole
            self._write_layer(step, weight, bias)

    def _write_layer(self, step: _Step, weight: Array, bias: Array) -> None:
        node = step.node
        given = self._attributes(node)
        value = weight / given.get("alpha", 1.0)
        self._set(node, 1, value.T if given.get("transB", 0) else value)
        if step.bias is not None:
            adder, at = step.bias
            beta = given.get("beta", 1.0) if adder is node else 1.0
            self._set(adder, at, bias / beta)
        elif bias.any():
            self._add_bias(node, bias)

    def _add_bias(self, node: Any, bias: Array) -> None:
        """Add a bias to a layer without one."""
        like = self._type_of(node.input[1])
        if node.op_type == "Gemm":
            name = self._new(f"{node.input[1]}.bias", bias, like)
            del node.input[2:]
            node.input.append(name)
            return
        output = node.output[0]
        inner = self._free(f"{output}.product")
        name = self._new(f"{node.input[1]}.bias", bias, like)
        node.output[0] = inner
        added = self._onnx.helper.make_node("Add", [inner, name], [output])
        at = next(i for i, x in enumerate(self.graph.node) if inner in x.output)
        self.graph.node.insert(at + 1, added)

    def _set(self, node: Any, at: int, value: Array) -> None:
        """Write a constant that an operator reads; a shared one gets a copy of its own."""
        name = node.input[at]
        old = self._constant(name)
        assert old is not None
        same = old.size == value.size
        value = value.reshape(old.shape) if same else value
        root, turned, alone = self._root(name)
        kind = self._type_of(name)
        if not alone or not same:
            node.input[at] = self._new(f"{name}.learnt", value, kind)
            return
        value = value.T if turned else value
        if root in self._stored:
            self._stored[root].CopyFrom(self._tensor(root, value, kind))
            return
        constant = self._made_by[root]
        tensor = self._tensor("", value, kind)
        constant.attribute[0].CopyFrom(self._onnx.helper.make_attribute("value", tensor))

    def _type_of(self, name: str) -> np.dtype[Any]:
        root = self._root(name)[0]
        if root in self._stored:
            kind: np.dtype[Any] = self._onnx.numpy_helper.to_array(self._stored[root]).dtype
            return kind
        value = self._onnx.helper.get_attribute_value(self._made_by[root].attribute[0])
        is_tensor = self._made_by[root].attribute[0].name == "value"
        return self._onnx.numpy_helper.to_array(value).dtype if is_tensor else np.dtype(np.float32)

    def _tensor(self, name: str, value: Array, kind: np.dtype[Any]) -> Any:
        return self._onnx.numpy_helper.from_array(np.ascontiguousarray(value, kind), name)

    def _new(self, wanted: str, value: Array, kind: np.dtype[Any]) -> str:
        """Store a new constant, and return its name."""
        name = self._free(wanted)
        self.graph.initializer.append(self._tensor(name, value, kind))
        self._stored[name] = self.graph.initializer[-1]
        self._uses[name] = 1
        return name

    def _free(self, wanted: str) -> str:
        """Return a name that nothing in the graph has."""
        names = {*self._uses, *self._made_by, *self._stored, *self._inputs}
        return next(x for i in range(len(names) + 1) if (x := wanted + "_" * i) not in names)


def _read(graph: Any) -> Iterator[str]:
    """Yield the names that nodes of a graph read, once for each use, also in graphs inside."""
    for node in graph.node:
        yield from node.input
        for attribute in node.attribute:
            inner: Sequence[Any] = [attribute.g, *attribute.graphs]
            for one in inner:
                yield from _read(one)
                yield from (x.name for x in one.output)
