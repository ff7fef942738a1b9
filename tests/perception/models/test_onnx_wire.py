"""The ONNX bytes that touchcell writes are read, validated and reproduced by the ``onnx`` package."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.perception.models.test_model_file import make_model
from touchcell.perception.models import onnx_wire
from touchcell.perception.models.architecture import Architecture
from touchcell.perception.models.graph import onnx_model
from touchcell.perception.models.model_file import Model


@pytest.mark.parametrize("kind", ["gdn", "cnn"])
def test_onnx_accepts_a_contact_network(kind: str) -> None:
    onnx = pytest.importorskip("onnx")
    base = make_model()
    architecture = base.header.architecture.model_copy(update={"kind": kind})
    assert isinstance(architecture, Architecture)
    rng = np.random.default_rng(0)
    tensors = {n: rng.normal(size=s).astype(np.float32) for n, s in architecture.tensor_shapes().items()}
    header = base.header.model_copy(update={"architecture": architecture})
    read = onnx.load_from_string(onnx_model(Model(header, tensors)))
    onnx.checker.check_model(read, full_check=True)
    found = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in read.graph.initializer}
    for name, tensor in tensors.items():
        np.testing.assert_array_equal(found[name], tensor)
    first = read.graph.node[0]
    assert (first.op_type, first.input[0]) == ("Conv", "images")
    assert {a.name: onnx.helper.get_attribute_value(a) for a in first.attribute} == {
        "kernel_shape": [3, 3],
        "pads": [1, 1, 1, 1],
    }
    assert read.graph.input[0].type.tensor_type.shape.dim[0].dim_param == "n"
    assert read.opset_import[0].version == 17


@given(st.integers(0, 2**40), st.lists(st.integers(0, 2**63 - 1), min_size=1, max_size=4))
def test_numbers_of_any_length_survive(single: int, several: list[int]) -> None:
    onnx = pytest.importorskip("onnx")
    read = onnx.NodeProto.FromString(onnx_wire.node("Op", ["a" * 300, "b"], "c", {"one": single, "some": several}))
    assert (list(read.input), list(read.output)) == (["a" * 300, "b"], ["c"])
    assert [onnx.helper.get_attribute_value(a) for a in read.attribute] == [single, several]


def test_other_types_are_refused() -> None:
    with pytest.raises(TypeError, match="float64"):
        onnx_wire.model([], {"a": np.zeros(3)}, {}, {})  # type: ignore[dict-item]


def test_serving_does_not_import_onnx() -> None:
    program = (
        "import sys; sys.path.insert(0, 'tests'); from touchcell.perception.runtime.estimators import load_estimator\n"
        "from pathlib import Path; load_estimator(Path('touchcell/perception/models/sim_gdn.safetensors'))\n"
        "print(sorted({'onnx', 'torch', 'matplotlib', 'google'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout.strip() == "[]"
