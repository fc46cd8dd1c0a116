"""Policies of ONNX files: plain layers become arrays, any other graph runs in onnxruntime."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.bounded import POLICY, open_plain, read_bytes
from oodd_eval.data.files import replacing
from oodd_eval.errors import MissingExtraError, PolicyError
from oodd_recording.mlp import NUMBERS

Arrays = dict[str, NDArray[Any]]

_PASSED: Final = {"Identity", "Flatten", "Reshape", "Squeeze", "Unsqueeze", "Dropout"}
"""Operations that leave the numbers of one row as they are."""

_FLOATS: Final = {1, 11}  # numbers that ONNX gives the types float32 and float64

_PLAIN: Final = {"Relu": "relu", "Tanh": "tanh", "Sigmoid": "sigmoid", "Softplus": "softplus"}


class _NotPlainError(Exception):
    """The graph is more than layers in a row."""


def read_model(path: Path, *, beside: bool = False) -> Any:
    """Return the model of an ONNX file; `PolicyError` where it is none.

    With `beside` its weights may be in other files of the same directory; the model then has them.
    """
    try:
        import onnx  # noqa: PLC0415  of an extra
    except ImportError as error:
        raise MissingExtraError(
            f"policies in ONNX need the extra onnx ({error}): pip install 'oodd-eval[onnx]'"
        ) from error
    content = read_bytes(path, POLICY.most, PolicyError)
    try:
        model = onnx.load_model_from_string(content)
        outside = [tensor for tensor in _tensors(model) if tensor.data_location]
        room = POLICY.most - len(content)
        for tensor in outside if beside else ():
            room -= _take_in(tensor, path, room)
        if beside or not outside:
            onnx.checker.check_model(model)
            for tensor in _tensors(model):  # as many numbers as it announces
                onnx.numpy_helper.to_array(tensor)
    except PolicyError:
        raise
    except Exception as error:  # protobuf's and onnx's have no common base
        text = str(error).partition("\n")[0]
        raise PolicyError(
            f"{path.name} is no ONNX model: {text:.200}; expected a whole file, as "
            "onnx.save_model writes it"
        ) from error
    if outside and not beside:
        raise PolicyError(
            f"{path.name} keeps weights in other files, expected one file: take it over with "
            "`oodd-eval policies import`"
        )
    return model


def _take_in(tensor: Any, path: Path, room: int) -> int:
    """Put the content of a tensor that is in a file beside the model into it; return its bytes."""
    facts = {entry.key: entry.value for entry in tensor.external_data}
    name, offset = facts.get("location", ""), int(facts.get("offset", 0))
    length = int(facts.get("length", room + 1))
    file = path.parent / name
    # Links count where they lead: a cache may have both files elsewhere, but together.
    if Path(name).name != name or file.resolve().parent != path.resolve().parent:
        raise PolicyError(
            f"{path.name} keeps weights in {name!r:.200}, expected a file in its own directory"
        )
    try:
        with open_plain(file) as opened:
            opened.seek(offset)
            content = opened.read(min(max(length, 0), room + 1))
    except OSError as error:
        raise PolicyError(
            f"{path.name} keeps weights in {name!r}, which cannot be read ({error.strerror}): "
            "expected that file beside it"
        ) from error
    if len(content) > room:
        raise PolicyError(f"{path.name} has, with other files, more than {POLICY.most} bytes")
    tensor.raw_data = content
    tensor.ClearField("data_location")
    tensor.ClearField("external_data")
    return len(content)


def _tensors(message: Any) -> Iterator[Any]:
    """Yield the tensors that a model, or a part of it, has at any depth."""
    for field, value in message.ListFields():
        if field.message_type is not None:
            for inner in value if isinstance(value, Sequence) else [value]:
                if field.message_type.name == "TensorProto":
                    yield inner
                else:
                    yield from _tensors(inner)


def layers_of(path: Path, output: str = "") -> Arrays | None:
    """Return the arrays of a policy of plain layers, see `oodd_recording.mlp`; None for others.

    Parameters
    ----------
    path
        An ONNX file whose first input is a row of observations, with a batch of one before it;
        weights may be in files beside it.
    output
        Name of the output with the action, by default the first.
    """
    graph = read_model(path, beside=True).graph
    try:
        return _walk(graph, _name_of_output(graph, output, path.name))
    except _NotPlainError:
        return None


def _name_of_output(graph: Any, output: str, file: str) -> str:
    names = [value.name for value in graph.output]
    if output and output not in names:
        raise PolicyError(f"{file} has outputs {', '.join(names)}, expected {output!r}")
    return output or names[0]


def _walk(graph: Any, output: str) -> Arrays:
    """Follow the graph from its first input to an output, and collect operations."""
    from onnx import numpy_helper  # noqa: PLC0415  of an extra

    constants = {t.name: numpy_helper.to_array(t) for t in graph.initializer}
    for node in graph.node:
        if node.op_type == "Constant":
            value = _attributes(node).get("value")
            if value is None:  # not a tensor
                raise _NotPlainError
            constants[node.output[0]] = numpy_helper.to_array(value)
    inputs = [value.name for value in graph.input if value.name not in constants]
    if not inputs:
        raise _NotPlainError
    makers = {name: node for node in graph.node for name in node.output}
    operations: list[tuple[str, Any, Any]] = []  # the last one first
    current = output
    while current != inputs[0]:
        if current not in makers:
            raise _NotPlainError
        node = makers[current]
        rows = [name for name in node.input if name and name not in constants]
        if _is_swish(node, makers):
            operations.append(("silu", 0.0, 0.0))
        elif len(rows) != 1:
            raise _NotPlainError
        elif node.op_type == "Split" and _is_even(node):
            parts = [*node.output]
            operations.append(("part", parts.index(current), len(parts)))
        else:
            operations += _operations(node, constants)
        current = rows[0]
    arrays: Arrays = {}
    for i, (_, a, b) in enumerate(reversed(operations)):
        arrays |= {f"a{i}": np.asarray(a), f"b{i}": np.asarray(b)}
    steps = [NUMBERS[name] for name, _, _ in reversed(operations)]
    return {"steps": np.array(steps, np.int64), **arrays}


def _is_even(node: Any) -> bool:
    """Tell whether a node splits a row, not a batch, into parts that nothing makes uneven."""
    attributes = _attributes(node)
    whole = len(node.input) == 1 and "split" not in attributes
    return whole and attributes.get("axis", 0) in {1, -1}


def _is_swish(node: Any, makers: Mapping[str, Any]) -> bool:
    """Tell whether a node is the last of x sigmoid(x), which its first input is."""
    if node.op_type != "Mul":
        return False
    gate = makers.get(node.input[1])
    return gate is not None and gate.op_type == "Sigmoid" and gate.input[0] == node.input[0]


def _attributes(node: Any) -> dict[str, Any]:
    from onnx import helper  # noqa: PLC0415  of an extra

    return {a.name: helper.get_attribute_value(a) for a in node.attribute}


def _operations(node: Any, constants: Mapping[str, NDArray[Any]]) -> list[tuple[str, Any, Any]]:
    """Return what a node does to one row, as operations of `oodd_recording.mlp`."""
    kind, attributes = node.op_type, _attributes(node)
    operands = [constants[name] for name in node.input if name in constants]
    first_is_row = node.input[0] not in constants
    if kind in _PASSED or (kind == "Cast" and attributes["to"] in _FLOATS):
        return []
    if kind in _PLAIN:
        return [(_PLAIN[kind], 0.0, 0.0)]
    if kind == "Elu":
        return [("elu", attributes.get("alpha", 1.0), 0.0)]
    if kind == "LeakyRelu":
        return [("leaky-relu", attributes.get("alpha", 0.01), 0.0)]
    if kind == "Clip":
        named = dict(zip(("low", "high"), node.input[1:], strict=False))
        low = constants[named["low"]] if named.get("low") else attributes.get("min", -np.inf)
        high = constants[named["high"]] if named.get("high") else attributes.get("max", np.inf)
        return [("clip", low, high)]
    if kind == "MatMul" and first_is_row and operands[0].ndim == 2:
        return [("affine", operands[0], np.zeros(operands[0].shape[1]))]
    if kind == "Gemm" and first_is_row and not attributes.get("transA", 0):
        weights = operands[0].T if attributes.get("transB", 0) else operands[0]
        shift = operands[1] if len(operands) > 1 else np.zeros(weights.shape[1])
        scaled = attributes.get("beta", 1.0) * shift.reshape(-1)
        return [("affine", attributes.get("alpha", 1.0) * weights, scaled)]
    if (
        kind in {"Add", "Sub", "Mul", "Div"}
        and max(operands[0].shape, default=1) == operands[0].size
    ):
        return [_scaled(kind, operands[0].reshape(-1).astype(np.float64), first=first_is_row)]
    raise _NotPlainError


def _scaled(kind: str, operand: NDArray[Any], *, first: bool) -> tuple[str, Any, Any]:
    one, none = np.ones_like(operand), np.zeros_like(operand)
    if kind == "Add":
        return "scale", one, operand
    if kind == "Mul":
        return "scale", operand, none
    if kind == "Sub":
        return ("scale", one, -operand) if first else ("scale", -one, operand)
    if not first:
        raise _NotPlainError
    return "scale", 1 / operand, none


def write_policy(path: Path, tensor: str, arrays: Arrays | None, output: Path) -> None:
    """Write arrays as ``.npz``; without any the graph, cut to one output, as ``.onnx``."""
    with replacing(output) as partial, partial.open("wb") as file:
        if arrays is not None:
            np.savez_compressed(file, allow_pickle=False, **arrays)
            return
        model = read_model(path, beside=True)
        name = _name_of_output(model.graph, tensor, path.name)
        kept = next(value for value in model.graph.output if value.name == name)
        copy = type(kept)()
        copy.CopyFrom(kept)
        del model.graph.output[:]
        model.graph.output.append(copy)
        file.write(model.SerializeToString())


def session_of(path: Path) -> Callable[[NDArray[np.float32]], NDArray[Any]]:
    """Return what runs a row through a graph in onnxruntime, on one thread."""
    try:
        import onnxruntime  # noqa: PLC0415  of an extra
    except ImportError as error:
        raise MissingExtraError(
            f"this policy is more than plain layers and needs onnxruntime ({error}): "
            "pip install 'oodd-eval[onnx]'"
        ) from error
    name = _name_of_output(read_model(path).graph, "", path.name)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    content = read_bytes(path, POLICY.most, PolicyError)
    session = onnxruntime.InferenceSession(content, options, ["CPUExecutionProvider"])
    (entry, *others) = session.get_inputs()
    if others:
        named = ", ".join(value.name for value in others)
        raise PolicyError(
            f"{path.name} needs {named} besides a row: expected a policy without memory; write a "
            "class with act(row) and reset() in a plug-in, and call onnxruntime in it"
        )

    def run(row: NDArray[np.float32]) -> NDArray[Any]:
        return np.asarray(session.run([name], {entry.name: row[None]})[0]).reshape(-1)

    return run
