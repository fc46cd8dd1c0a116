"""Policies of ONNX files: plain layers as arrays, other graphs as they are, and what is refused."""

import dataclasses
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx", reason="needs the extra onnx")
pytest.importorskip("onnxruntime", reason="needs the extra onnx")
pytest.importorskip("gymnasium", reason="needs the extra gym")
import onnx
import onnxruntime
from helpers_own import CISTERN, forget_own
from helpers_plugins import install
from onnx import TensorProto, helper, numpy_helper
from oodd_recording import onnx_files
from oodd_recording.onnx_files import layers_of, read_model
from oodd_recording.policies import load_policy

from oodd_eval import load_split
from oodd_eval.cli.main import main
from oodd_eval.data import bounded
from oodd_eval.data.registry import register
from oodd_eval.errors import MissingExtraError, PolicyError

D, A, HIDDEN = 3, 1, 16  # of the cistern, whose actions are 0 to 8 V
RNG = np.random.default_rng(5)
WEIGHTS = {
    "mean": np.array([1.0, 0.3, 1.1], np.float32),
    "spread": np.array([0.2, 0.1, 0.2], np.float32),
    "W1": RNG.normal(size=(D, HIDDEN)).astype(np.float32),
    "b1": RNG.normal(size=HIDDEN).astype(np.float32),
    "W2": RNG.normal(size=(HIDDEN, HIDDEN)).astype(np.float32) / 4,
    "b2": RNG.normal(size=HIDDEN).astype(np.float32),
    "W3": RNG.normal(size=(A, HIDDEN)).astype(np.float32) / 4,
    "b3": np.array([3.0], np.float32),
}
WHITENED = [("Sub", "obs mean", "d", {}), ("Div", "d spread", "z", {})]
MLP = [
    *WHITENED,
    ("Gemm", "z W1 b1", "u", {}),
    ("Elu", "u", "v", {"alpha": 0.7}),
    ("MatMul", "v W2", "m", {}),
    ("Add", "m b2", "n", {}),
    ("Mul", "n gate", "s", {}),
    ("Gemm", "s W3 b3", "action", {"transB": 1}),
]
MLP.insert(6, ("Sigmoid", "n", "gate", {}))


def graph(nodes, inputs=(("obs", D),), outputs=(("action", A),), weights=WEIGHTS):
    """A model of nodes (operation, inputs, output, attributes), with rows of float32."""
    made = [
        helper.make_node(kind, read.split(), written.split(), **attributes)
        for kind, read, written, attributes in nodes
    ]
    used = {name for _, read, _, _ in nodes for name in read.split()}
    columns = [
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, width]) for n, width in values]
        for values in (inputs, outputs)
    ]
    stored = [numpy_helper.from_array(w, n) for n, w in weights.items() if n in used]
    return helper.make_model(
        helper.make_graph(made, "policy", *columns, stored),
        opset_imports=[helper.make_opsetid("", 17)],
        ir_version=8,
    )


@pytest.fixture
def cistern(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path / "plugin", "cistern", CISTERN, header="")
    monkeypatch.setenv("OODD_EVAL_DATA", str(tmp_path / "splits"))
    register(__import__("oodd_cistern").oodd_environments())
    yield tmp_path
    forget_own()


def save(model, path):
    onnx.save_model(model, path)
    return path


def imported(path, output, *options):
    arguments = [str(path), "--env", "cistern", "--output", str(output)]
    return main(["policies", "import", *arguments, *options])


def outputs_of(path, rows):
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    name = session.get_inputs()[0].name
    return np.array([session.run(None, {name: row[None]})[0][0] for row in rows])


def near_rows():
    rng = np.random.default_rng(6)
    return (WEIGHTS["mean"] + WEIGHTS["spread"] * rng.normal(size=(200, D))).astype(np.float32)


def test_plain_layers_become_arrays_that_act_as_onnxruntime_does(cistern, capsys):
    path, rows = save(graph(MLP), cistern / "actor.onnx"), near_rows()
    assert imported(path, cistern / "actor.npz") == 0
    assert "mean return" in capsys.readouterr().out
    policy = load_policy("cistern", cistern / "actor.npz")
    expected = np.clip(outputs_of(path, rows), 0, 8)
    actions = np.array([policy.act(row) for row in rows])
    # onnxruntime computes in float32: some 1e-6; actions are on a grid of 2^-16.
    np.testing.assert_allclose(actions, expected, rtol=0, atol=1e-6 + 2.0**-17)
    assert len(np.unique(actions)) > 100
    layers = np.array([policy._outputs(row) for row in rows])
    np.testing.assert_allclose(layers, outputs_of(path, rows), rtol=1e-6, atol=1e-6)


def test_a_graph_with_a_branch_stays_a_graph_and_acts(cistern):
    nodes = [
        *WHITENED,
        ("Gemm", "z W1 b1", "u", {}),
        ("Tanh", "u", "v", {}),
        ("MatMul", "v W2", "m", {}),
        ("Add", "m v", "s", {}),  # past a layer
        ("Gemm", "s W3 b3", "action", {"transB": 1}),
    ]
    path, rows = save(graph(nodes), cistern / "actor.onnx"), near_rows()
    assert layers_of(path) is None
    assert imported(path, cistern / "kept.onnx") == 0
    policy = load_policy("cistern", cistern / "kept.onnx")
    expected = np.clip(outputs_of(path, rows), 0, 8)
    actions = np.array([policy.act(row) for row in rows])
    np.testing.assert_allclose(actions, expected, rtol=0, atol=2.0**-17 + 1e-9)


def test_an_imported_policy_records_a_split_that_names_it(cistern):
    path = save(graph(MLP), cistern / "actor.onnx")
    assert imported(path, cistern / "actor.npz") == 0
    build = ["data", "build", "--env", "cistern", "--train", "2", "--calibration", "2",
             "--test", "1", "--seed-base", "77", "--strength", "offset=0.3",
             "--jobs", "1"]  # fmt: skip
    assert main([*build, "other", "--policy", str(cistern / "actor.npz")]) == 0
    assert main([*build, "usual"]) == 0
    entries = [load_split(n).manifest["environments"]["cistern"] for n in ("other", "usual")]
    assert entries[0]["policy"] != entries[1]["policy"]
    policy = load_policy("cistern", cistern / "actor.npz")
    episode = load_split("other").environment("cistern").train[0]
    acted = [policy.act(row) for row in episode.observations[:-1]]
    np.testing.assert_array_equal(acted, episode.actions)


def test_an_output_is_chosen_by_its_name(cistern, capsys):
    nodes = [*MLP[:-1], ("Gemm", "s W2 b2", "value", {}), MLP[-1]]
    model = graph(nodes, outputs=(("value", HIDDEN), ("action", A)))
    path = save(model, cistern / "actor.onnx")
    assert imported(path, cistern / "actor.npz") == 4
    assert "maps 3 sensors to 16 actions, expected 3 and 1" in capsys.readouterr().err
    assert not (cistern / "actor.npz").exists()
    assert imported(path, cistern / "actor.npz", "--tensor", "action") == 0
    assert imported(path, cistern / "actor.npz", "--tensor", "acton") == 4
    assert "has outputs value, action, expected 'acton'" in capsys.readouterr().err


LAST = ("Gemm", "s W3 b3", "action", {"transB": 1})
FIRST = [*WHITENED, ("Gemm", "z W1 b1", "u", {})]


@pytest.mark.parametrize(
    ("nodes", "plain"),
    [
        ([("Relu", "u", "s", {})], True),
        ([("LeakyRelu", "u", "s", {"alpha": 0.3})], True),
        ([("Softplus", "u", "s", {})], True),
        ([("Sigmoid", "u", "s", {})], True),
        ([("Clip", "u low high", "s", {})], True),
        ([("Sub", "b1 u", "s", {})], True),
        ([("Identity", "u", "s", {})], True),
        ([("Cast", "u", "s", {"to": TensorProto.FLOAT})], True),
        ([("Cast", "u", "w", {"to": TensorProto.INT64}),
          ("Cast", "w", "s", {"to": TensorProto.FLOAT})], False),
        ([("Div", "b1 u", "s", {})], False),
        ([("Mul", "u u", "s", {})], False),
        ([("Softmax", "u", "s", {})], False),
    ],
)  # fmt: skip
def test_each_operation_is_what_onnxruntime_makes_of_it_or_is_left_to_it(cistern, nodes, plain):
    ends = {"low": np.array(-0.5, np.float32), "high": np.array(0.7, np.float32)}
    model = graph([*FIRST, *nodes, LAST], weights=WEIGHTS | ends)
    path, rows = save(model, cistern / "actor.onnx"), near_rows()
    assert (layers_of(path) is not None) == plain
    output = cistern / ("actor.npz" if plain else "kept.onnx")
    assert imported(path, output) == 0
    actions = np.array([load_policy("cistern", output).act(row) for row in rows])
    expected = np.clip(outputs_of(path, rows), 0, 8)
    np.testing.assert_allclose(actions, expected, rtol=0, atol=2e-6 + 2.0**-17)


@pytest.mark.parametrize(
    ("sizes", "plain"), [(None, True), ([HIDDEN // 2, HIDDEN // 2], False), ([10, 6], False)]
)
def test_a_part_of_a_row_is_taken_where_parts_are_even(cistern, sizes, plain):
    """As of a policy that gives means and spreads; uneven ones go to onnxruntime."""
    width = HIDDEN // 2 if sizes is None else sizes[0]
    weights = WEIGHTS | {"W4": WEIGHTS["W3"][:, :width].copy()}
    read = "u"
    if sizes is not None:
        weights, read = weights | {"sizes": np.array(sizes)}, "u sizes"
    nodes = [*FIRST, ("Split", read, "s rest", {"axis": 1}),
             ("Gemm", "s W4 b3", "action", {"transB": 1})]  # fmt: skip
    path, rows = save(graph(nodes, weights=weights), cistern / "actor.onnx"), near_rows()
    assert (layers_of(path) is not None) == plain
    output = cistern / ("actor.npz" if plain else "kept.onnx")
    assert imported(path, output) == 0
    actions = np.array([load_policy("cistern", output).act(row) for row in rows])
    np.testing.assert_allclose(
        actions, np.clip(outputs_of(path, rows), 0, 8), rtol=0, atol=2e-6 + 2.0**-17
    )


RECURRENT = graph([*FIRST, ("Add", "u h", "s", {}), LAST], inputs=(("obs", D), ("h", HIDDEN)))
UNDEFINED = graph(MLP, weights=WEIGHTS | {"b2": np.full(HIDDEN, np.nan, np.float32)})


@pytest.mark.parametrize(
    ("model", "name", "parts"),
    [
        (RECURRENT, "kept.onnx",
         ["needs h besides a row: expected a policy without memory", "act(row) and reset()"]),
        (UNDEFINED, "actor.npz", ["NaN"]),
        (graph(MLP), "actor.onnx.copy",
         ["is layers in a row: expected an --output that ends in .npz"]),
    ],
    ids=["recurrent", "not finite", "name of the output"],
)  # fmt: skip
def test_what_is_no_policy_of_a_row_is_refused_and_leaves_no_file(
    cistern, capsys, model, name, parts
):
    assert imported(save(model, cistern / "actor.onnx"), cistern / name) == 4
    told = capsys.readouterr().err
    assert all(part in told for part in parts)
    assert not (cistern / name).exists()


def split_in_two(path, nodes=MLP):
    """Save a policy with all its weights in a second file, as torch does; return that file."""
    onnx.save_model(
        graph(nodes), path, save_as_external_data=True, location="weights.bin", size_threshold=0
    )
    return path.with_name("weights.bin")


def moved(path, **facts):
    """Change where the first tensor of a policy in two files is said to be."""
    model = onnx.load_model(path, load_external_data=False)
    for entry in model.graph.initializer[0].external_data:
        entry.value = facts.get(entry.key, entry.value)
    path.write_bytes(model.SerializeToString())
    return path


BRANCHED = [*FIRST, ("Add", "u u", "v", {}), ("Mul", "u v", "s", {}), LAST]


@pytest.mark.parametrize(("nodes", "name"), [(MLP, "actor.npz"), (BRANCHED, "kept.onnx")])
def test_weights_in_a_second_file_are_taken_over(cistern, nodes, name):
    path, rows = cistern / "actor.onnx", near_rows()
    (cistern / "two").mkdir()
    save(graph(nodes), path)
    file = split_in_two(cistern / "two" / "actor.onnx", nodes)
    assert file.stat().st_size > 300
    assert imported(cistern / "two" / "actor.onnx", cistern / name) == 0
    file.unlink()  # the policy does not need it any more
    actions = [load_policy("cistern", cistern / name).act(row) for row in rows]
    np.testing.assert_allclose(
        actions, np.clip(outputs_of(path, rows), 0, 8), rtol=0, atol=2e-6 + 2.0**-17
    )


def test_a_cache_of_links_has_both_files(cistern):
    (cistern / "blobs").mkdir()
    (cistern / "snapshot").mkdir()
    split_in_two(cistern / "blobs" / "actor.onnx")
    for name in ("actor.onnx", "weights.bin"):
        (cistern / "snapshot" / name).symlink_to(cistern / "blobs" / name)
    assert imported(cistern / "snapshot" / "actor.onnx", cistern / "actor.npz") == 0


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        ({"location": "../secret.bin"}, "expected a file in its own directory"),
        ({"location": "/etc/passwd"}, "expected a file in its own directory"),
        ({"location": "sub/weights.bin"}, "expected a file in its own directory"),
        ({"location": ""}, "expected a file in its own directory"),
        ({"location": ".."}, "expected a file in its own directory"),
        ({"location": "linked.bin"}, "expected a file in its own directory"),
        ({"location": "gone.bin"}, "cannot be read"),
        ({"location": "pipe"}, "cannot be read"),
        ({"location": "a\0b"}, "is no ONNX model"),
        ({"offset": "-1"}, "cannot be read"),
        ({"offset": "100000"}, "is no ONNX model"),
        ({"offset": "ten"}, "is no ONNX model"),
        ({"length": "8"}, "is no ONNX model"),
        ({"length": "-1"}, "is no ONNX model"),
        ({"length": "100000"}, "is no ONNX model"),
    ],
)
def test_weights_elsewhere_than_in_a_file_beside_are_refused(cistern, facts, message, capsys):
    folder = cistern / "policy"
    folder.mkdir()
    file = split_in_two(folder / "actor.onnx")
    (folder / "sub").mkdir()
    os.mkfifo(folder / "pipe")
    for copy in (cistern / "secret.bin", folder / "sub" / "weights.bin"):
        copy.write_bytes(file.read_bytes())
    (folder / "linked.bin").symlink_to(cistern / "secret.bin")
    assert imported(moved(folder / "actor.onnx", **facts), cistern / "actor.npz") == 4
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (cistern / "actor.npz").exists()


def test_files_of_weights_are_bounded_together(cistern, monkeypatch):
    path = cistern / "actor.onnx"
    file = split_in_two(path)
    sizes = path.stat().st_size + sum(w.nbytes for w in WEIGHTS.values())
    for most in (sizes - 1, sizes):
        monkeypatch.setattr(onnx_files, "POLICY", dataclasses.replace(bounded.POLICY, most=most))
        if most < sizes:
            with pytest.raises(PolicyError, match="has, with other files, more than"):
                read_model(path, beside=True)
        else:
            assert read_model(path, beside=True).graph.initializer[0].raw_data
    with file.open("ab") as opened:
        opened.truncate(2**40)  # a hole: only what tensors name is read
    assert read_model(path, beside=True)


def test_what_records_reads_one_file_alone(cistern):
    """What onnxruntime gets as bytes would look for other files in the current directory."""
    path = cistern / "actor.onnx"
    split_in_two(path)
    with pytest.raises(PolicyError, match="keeps weights in other files, expected one file"):
        load_policy("cistern", path)
    inner = numpy_helper.from_array(WEIGHTS["b1"], "secret")
    inner.data_location = TensorProto.EXTERNAL
    node = helper.make_node("Constant", [], ["secret"], value=inner)
    branch = helper.make_graph(
        [node], "then", [], [helper.make_tensor_value_info("secret", TensorProto.FLOAT, [HIDDEN])]
    )
    model = graph(MLP)
    model.graph.node.append(
        helper.make_node("If", ["flag"], ["action"], then_branch=branch, else_branch=branch)
    )
    path.write_bytes(model.SerializeToString())
    with pytest.raises(PolicyError, match="keeps weights in other files"):
        read_model(path)
    sparse = graph(MLP)
    sparse.graph.sparse_initializer.add().values.CopyFrom(inner)
    path.write_bytes(sparse.SerializeToString())
    with pytest.raises(PolicyError, match="keeps weights in other files"):
        read_model(path)
    with path.open("wb") as file:
        file.truncate(bounded.POLICY.most + 1)  # a hole
    with pytest.raises(PolicyError, match="has more than 268435456 bytes"):
        read_model(path)


def test_a_tensor_of_fewer_numbers_than_it_announces_is_refused(cistern):
    model = graph(MLP)
    model.graph.initializer[0].raw_data = b"1234"
    with pytest.raises(PolicyError, match=r"actor\.onnx is no ONNX model"):
        read_model(save(model, cistern / "actor.onnx"))


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")  # torch's own
def test_the_documented_line_of_torch_gives_a_policy(tmp_path, monkeypatch, capsys):
    """It puts large weights into a second file."""
    torch = pytest.importorskip("torch", reason="needs the extra train")
    pytest.importorskip("onnxscript", reason="needs the extra onnx")
    page = (Path(__file__).parents[2] / "docs/how-to/policies.md").read_text(encoding="utf-8")
    (line,) = re.findall(r"`(torch\.onnx\.export\(.*?\))`", page)
    monkeypatch.chdir(tmp_path)
    layers = [torch.nn.Linear(4, 64), torch.nn.Tanh(), torch.nn.Linear(64, 2)]
    actor = torch.nn.Sequential(*layers)
    exec(line, {"torch": torch, "actor": actor})  # noqa: S102  a line of our own page
    assert (tmp_path / "actor.onnx.data").stat().st_size > 1000
    arguments = ["actor.onnx", "--env", "cartpole", "--output", "actor.npz"]
    assert main(["policies", "import", *arguments]) == 0
    assert "mean return" in capsys.readouterr().out
    policy = load_policy("cartpole", "actor.npz")
    rows = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    expected = actor(torch.from_numpy(rows)).detach().numpy()
    values = np.array([policy._outputs(row) for row in rows])
    np.testing.assert_allclose(values, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_truncated_file_is_refused(cistern, share):
    content = graph(MLP).SerializeToString()
    path = cistern / "actor.onnx"
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(PolicyError, match=r"actor\.onnx is no ONNX model"):
        read_model(path)


def test_without_onnx_the_extra_is_named(cistern, monkeypatch):
    path = save(graph(MLP), cistern / "actor.onnx")
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(MissingExtraError, match=r"oodd-eval\[onnx\]"):
        read_model(path)


def test_a_file_of_other_arrays_is_no_policy_of_layers(cistern):
    np.savez(cistern / "odd.npz", steps=np.array([99]), a0=np.zeros((3, 1)), b0=np.zeros(1))
    with pytest.raises(PolicyError, match="no policy of layers that fit"):
        load_policy("cistern", cistern / "odd.npz")
