"""ONNX models that are changed, or that ask for what no model needs."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np


def change(rng: random.Random, path: Path, folder: Path) -> tuple[str, str, bool]:
    """Change a model; what was done. It may act otherwise where no run vouches for it."""
    import onnx

    model = onnx.load(str(path))
    graph = model.graph
    node, weight = graph.node[0], graph.initializer[0]
    kind = rng.choice(
        (
            "operator",
            "domain",
            "opset",
            "input shape",
            "input type",
            "no input",
            "weight NaN",
            "weight shape",
            "outside file",
            "no weight",
            "output name",
            "cycle",
            "huge constant",
        )
    )
    match kind:
        case "operator":
            node.op_type = rng.choice(("Add", "Gemm", "Evil", "", "MatMul\x00", "Loop", "If"))
        case "domain":
            node.domain = rng.choice(("evil", "ai.onnx.ml", "com.microsoft"))
        case "opset":
            model.opset_import[0].version = rng.choice((0, -1, 999, 7))
        case "input shape":
            graph.input[0].type.tensor_type.shape.dim[1].dim_value = rng.choice((0, 3, 2**40, -1))
        case "input type":
            graph.input[0].type.tensor_type.elem_type = rng.choice((0, 8, 9, 11, 99))
        case "no input":
            del graph.input[:]
        case "weight NaN":
            weight.raw_data = np.full((4, 2), np.nan, np.float32).tobytes()
        case "weight shape":
            weight.dims[0] = rng.choice((0, 2, 5, 2**40, -1))
        case "outside file":
            weight.data_location = onnx.TensorProto.EXTERNAL
            weight.ClearField("raw_data")
            where = rng.choice(("/etc/passwd", "../../../../etc/passwd", "/dev/zero", "model.onnx"))
            weight.external_data.add(key="location", value=where)
        case "no weight":
            del graph.initializer[:]
        case "output name":
            node.output[0] = "elsewhere"
        case "cycle":
            node.input[0] = "logits"
        case "huge constant":
            extra = graph.node.add(op_type="ConstantOfShape", input=["size"], output=["big"])
            assert extra.op_type
            graph.initializer.append(onnx.numpy_helper.from_array(np.array([2**38]), "size"))
            graph.output[0].name = "big"
    path.write_bytes(model.SerializeToString())
    return kind, "", path.parent == folder and kind != "weight NaN"
