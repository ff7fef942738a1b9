"""Alternative runtimes of a contact network, for comparison with the product's own.

Each is configured for best performance on one thread and batches of one.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

from touchcell.cell.bench.quantiles import median_and_p99
from touchcell.perception.models.architecture import Architecture
from touchcell.perception.models.graph import onnx_model
from touchcell.perception.models.model_file import Model
from touchcell.perception.runtime.inference import Runner, onnx_runtime


def openvino(model: Model) -> Runner:
    """Load the network in OpenVINO, tuned for latency, one stream on one thread."""
    from openvino import Core

    core = Core()
    # By default it computes in half precision where the processor can, which is another estimator.
    settings = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_NUM_THREADS": 1,
        "NUM_STREAMS": 1,
        "INFERENCE_PRECISION_HINT": "f32",
    }
    compiled = core.compile_model(core.read_model(model=onnx_model(model)), "CPU", settings)
    request = compiled.create_infer_request()

    def run(inputs: NDArray[np.float32]) -> NDArray[np.float32]:
        outputs: NDArray[np.float32] = request.infer([inputs])[0].copy()
        return outputs

    return run


def torch(model: Model) -> Runner:
    """Load the network in PyTorch: traced, frozen, optimized for inference, channels last."""
    import torch as pytorch
    from torch.nn import functional

    from touchcell.perception.networks.contact_network import softbound

    architecture = model.header.architecture
    assert isinstance(architecture, Architecture)
    pytorch.set_num_threads(1)
    weights = {name: pytorch.from_numpy(tensor.copy()) for name, tensor in model.tensors.items()}
    blocks = len(architecture.channels)
    for i in range(blocks):
        weights[f"conv{i}.weight"] = weights[f"conv{i}.weight"].contiguous(memory_format=pytorch.channels_last)
    bounds = None if architecture.bounds is None else [pytorch.tensor(bound) for bound in architecture.bounds]

    class Folded(pytorch.nn.Module):
        def forward(self, images: pytorch.Tensor) -> pytorch.Tensor:
            x = images.contiguous(memory_format=pytorch.channels_last)
            for i in range(blocks):
                x = functional.conv2d(x, weights[f"conv{i}.weight"], weights[f"conv{i}.bias"], padding=1)
                x = functional.max_pool2d(functional.relu(x), 2)
            x = functional.relu(functional.linear(x.flatten(1), weights["hidden.weight"], weights["hidden.bias"]))
            x = functional.linear(x, weights["output.weight"], weights["output.bias"])
            return x if bounds is None else softbound(x, *bounds)

    example = pytorch.zeros(1, 1, *architecture.input_size)
    with warnings.catch_warnings(), pytorch.inference_mode():
        # TorchScript is deprecated, and still the fastest in PyTorch without a minute of compiling.
        warnings.simplefilter("ignore")
        traced = pytorch.jit.trace(Folded().eval(), example)  # type: ignore[no-untyped-call]
        frozen = pytorch.jit.optimize_for_inference(pytorch.jit.freeze(traced))

    def run(inputs: NDArray[np.float32]) -> NDArray[np.float32]:
        with pytorch.inference_mode():
            outputs: NDArray[np.float32] = frozen(pytorch.from_numpy(inputs)).numpy()
        return outputs

    return run


def opencv(model: Model) -> Runner:
    """Load the network in OpenCV's DNN module, which every serving process has loaded anyway."""
    import cv2

    network = cv2.dnn.readNetFromONNX(np.frombuffer(onnx_model(model), np.uint8))

    def run(inputs: NDArray[np.float32]) -> NDArray[np.float32]:
        network.setInput(inputs)
        outputs: NDArray[np.float32] = network.forward()
        return outputs

    return run


RUNTIMES: dict[str, Callable[[Model], Runner]] = {
    "onnxruntime": onnx_runtime,
    "opencv": opencv,
    "openvino": openvino,
    "torch": torch,
}


def by_turns(model: Model, runtimes: Sequence[str], rounds: int) -> dict[str, dict[str, float]]:
    """Return milliseconds of the network alone in each runtime, all of them alternating in one process.

    On a machine with other load, consecutive processes meet different competition; alternating runtimes meet the same.
    """
    architecture = model.header.architecture
    assert isinstance(architecture, Architecture)
    runners = {name: RUNTIMES[name](model) for name in runtimes}
    image = np.random.default_rng(0).random((1, 1, *architecture.input_size), dtype=np.float32)
    times_ns: dict[str, list[int]] = {name: [] for name in runners}
    for _ in range(rounds):
        for name, runner in runners.items():
            start_ns = time.process_time_ns()
            runner(image)
            times_ns[name].append(time.process_time_ns() - start_ns)
    return {name: median_and_p99(row, 1e-6) for name, row in times_ns.items()}


def installed() -> list[str]:
    """Return the installed runtimes."""
    return [name for name in RUNTIMES if find_spec(name.replace("opencv", "cv2")) is not None]
