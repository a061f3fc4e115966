"""An agent as an ONNX file: normalised observation in, normalised control out, checked against PyTorch."""

import json
from dataclasses import asdict

import numpy as np
import onnx
import onnxruntime
import torch
from onnx import TensorProto, helper, numpy_helper

from inspection.model.parameters import ChiefParameters, InspectionParameters
from inspection.model.state import CONTROL_SIZE, CONTROLS
from inspection.observation import Component, components
from ppo.network import Policy
from study.errors import ExportError

# runtimes of the last years read these versions; tanh and affine maps need nothing newer
OPSET, IR_VERSION = 17, 8
SAMPLES = 1000  # observations of the check
TOLERANCE = 1e-5
SHAPED = (  # sign(a) |a|^power, as `Policy.shaped`: each node's kind, inputs and output
    ("Abs", ["action"], "size"),
    ("Pow", ["size", "power"], "shape"),
    ("Sign", ["action"], "sign"),
    ("Mul", ["sign", "shape"], "control"),
)


def to_onnx(policy: Policy, c: InspectionParameters, chief: ChiefParameters) -> bytes:
    """Writes the network of a policy of one seed, layer by layer: its mean action, as `Policy.mean_action`.

    The input `observation` (batch, 26; as many as observed) and the output `control` (batch, 6) are float32 and divided
    by their scales. The metadata hold names, units and scales of the components of both as JSON lists, [inspection] and
    [chief] of the training, and action_period in s.
    """
    layers = list(policy.network.layers)
    weights, nodes = [], []
    for i, layer in enumerate(layers):
        last = i == len(layers) - 1
        columns = slice(CONTROL_SIZE if last else None)  # the last layer's others give the log-std
        for name, value in (("weight", layer.weight[0, :, columns]), ("bias", layer.bias[0, 0, columns])):
            weights.append(numpy_helper.from_array(value.detach().cpu().numpy(), f"{name}_{i}"))
        inputs = "observation" if i == 0 else f"hidden_{i}"
        output = "control" if last else f"hidden_{i + 1}"
        nodes.append(helper.make_node("Gemm", [inputs, f"weight_{i}", f"bias_{i}"], [f"affine_{i}"]))
        output = "action" if last and policy.power != 1.0 else output
        nodes.append(helper.make_node("Tanh", [f"affine_{i}"], [output]))
    if policy.power != 1.0:
        weights.append(numpy_helper.from_array(np.array(policy.power, np.float32), "power"))
        nodes += [helper.make_node(kind, given, [result]) for kind, given, result in SHAPED]
    batches = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
        for name, size in (("observation", layers[0].weight.shape[1]), ("control", CONTROL_SIZE))
    ]
    graph = helper.make_graph(nodes, "policy", batches[:1], batches[1:], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    helper.set_model_props(model, metadata(c, chief))
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def metadata(c: InspectionParameters, chief: ChiefParameters) -> dict[str, str]:
    """Returns the description of a file's numbers: component = number * scale, in unit."""
    controls = [
        Component(name, "N" if name.startswith("thrust") else "N m", limit)
        for name, limit in zip(CONTROLS, c.control_limit, strict=True)
    ]
    return {
        "observation": json.dumps([component._asdict() for component in components(c)]),
        "control": json.dumps([component._asdict() for component in controls]),
        "inspection": json.dumps(asdict(c)),
        "chief": json.dumps(asdict(chief)),
        "action_period": json.dumps(c.action_period),
    }


def check(model: bytes, policy: Policy) -> float:
    """Returns the largest difference between ONNX Runtime's controls and PyTorch's, at observations of unit variance.

    Raises:
        ExportError: the difference exceeds TOLERANCE.
    """
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    shape = SAMPLES, policy.network.layers[0].weight.shape[1]
    observation = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    (control,) = session.run(None, {"observation": observation.numpy()})
    difference = float(np.abs(control - policy.mean_action(observation[None])[0].numpy()).max())
    if not difference <= TOLERANCE:
        raise ExportError(f"the exported controls differ from PyTorch's by {difference:.1g}")
    return difference
