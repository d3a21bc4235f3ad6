"""`export-policy`: a trained policy as TorchScript or ONNX, which run without offbench."""

# no `from __future__ import annotations` here: TorchScript reads the annotations of Actor
import io
import json
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from offbench.common.arrays import Array
from offbench.common.errors import OffbenchError
from offbench.common.files import output_file, write_bytes
from offbench.evaluation.policies import load_policy
from offbench.rollouts.policy import Policy

TORCHSCRIPT, ONNX = (".pt", ".pth", ".ts"), ".onnx"
ACTIVATIONS = {"relu": nn.ReLU, "tanh": nn.Tanh}
OPSET, IR_VERSION = 13, 8  # versions of ONNX that every onnxruntime since 1.10 reads


class Actor(nn.Module):
    """observations [n, obs] (any float type) -> actions [n, act] float32 in the environment's bounds: the mode.

    It computes in float64 until the end, as `Policy.act` does.
    """

    mean: Tensor
    std: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for weight, bias in policy.layers:
            linear = nn.Linear(weight.shape[0], weight.shape[1], dtype=torch.float64)
            linear.weight.data, linear.bias.data = _double(weight.T), _double(bias)
            layers += [linear, ACTIVATIONS[policy.activation]()]
        self.network = nn.Sequential(*layers[:-1]).requires_grad_(False)
        self.actions = len(policy.low)
        self.squashed = policy.kind != "gaussian"
        self.register_buffer("mean", _double(policy.observation_mean))
        self.register_buffer("std", _double(policy.observation_std))
        self.register_buffer("low", _double(policy.low))
        self.register_buffer("high", _double(policy.high))

    def forward(self, observations: Tensor) -> Tensor:
        """Return the actions."""
        out = self.network((observations.to(torch.float64) - self.mean) / self.std)
        actions = out[..., : self.actions]  # a Gaussian's other half is its log std
        if self.squashed:
            actions = self.low + (torch.tanh(actions) + 1.0) * (self.high - self.low) / 2.0
        return torch.minimum(torch.maximum(actions, self.low), self.high).to(torch.float32)


def _double(array: Array) -> Tensor:
    return torch.from_numpy(array.astype("float64"))


def export_policy(path: str | Path, out: str | Path) -> Path:
    """Write a run's policy, or a policy file, as TorchScript (`.pt`) or ONNX (`.onnx`).

    `torch.jit.load(out)(observations)` acts, as does
    `onnxruntime.InferenceSession(out).run(None, {"observations": observations})[0]`. Observations are `[n, obs]`, of
    any float type for TorchScript and float64 for ONNX; actions are `[n, act]`, float32. The file also holds where the
    policy comes from: `_extra_files` "offbench.json", or ONNX's `metadata_props` "offbench".

    Raises:
        OffbenchError: there is no policy, it has no single best action, the file ends in neither, its folder does not
            exist, it cannot be written, or the package onnx is not installed.
    """
    source, target = Path(path), output_file(out)
    ending = target.suffix.lower()
    if ending not in (*TORCHSCRIPT, ONNX):
        raise OffbenchError(
            f"cannot write {target.name!r}: policies become TorchScript or ONNX; give --out FILE.pt or FILE.onnx"
        )
    policy = load_policy(source)
    if policy.kind not in ("tanh", "squashed_gaussian", "gaussian"):
        reason = "chooses among random actions" if policy.kind == "best_by_q" else "is random"
        raise OffbenchError(f"{path} {reason} ({policy.kind}); only policies with one best action can be exported")
    origin = json.dumps({"env_id": policy.env_id, "kind": policy.kind, "origin": policy.origin})
    write_bytes(target, _onnx(policy, origin) if ending == ONNX else _torchscript(policy, origin))
    return target


def _torchscript(policy: Policy, origin: str) -> bytes:
    data = io.BytesIO()
    with warnings.catch_warnings():
        # deprecated, but every PyTorch since 1.0 reads it; files of torch.export need the version that wrote them
        warnings.simplefilter("ignore", DeprecationWarning)
        scripted = torch.jit.script(Actor(policy).eval())
        torch.jit.save(scripted, data, _extra_files={"offbench.json": origin})
    return data.getvalue()


def _onnx(policy: Policy, origin: str) -> bytes:
    """Return `Actor` as an ONNX graph, in float64 until its end."""
    try:
        from onnx import NodeProto, TensorProto, checker, helper, numpy_helper
    except ImportError:
        raise OffbenchError("ONNX export needs the package onnx: pip install 'offbench[onnx]'") from None
    constants: list[TensorProto] = []
    nodes: list[NodeProto] = []

    def constant(array: Array | np.float64) -> str:
        constants.append(numpy_helper.from_array(np.ascontiguousarray(array), f"c{len(constants)}"))
        return f"c{len(constants) - 1}"

    def node(kind: str, *inputs: str, output: str = "", **attributes: int) -> str:
        output = output or f"x{len(nodes)}"
        nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    layers = [(weight.astype(np.float64), bias.astype(np.float64)) for weight, bias in policy.layers]
    mean, std, low, high = (
        np.asarray(array, np.float64)
        for array in (policy.observation_mean, policy.observation_std, policy.low, policy.high)
    )
    actions = len(low)
    layers[-1] = (layers[-1][0][:, :actions], layers[-1][1][:actions])  # a Gaussian's other half is its log std
    x = node("Div", node("Sub", "observations", constant(mean)), constant(std))
    for index, (weight, bias) in enumerate(layers):
        x = node("Add", node("MatMul", x, constant(weight)), constant(bias))
        if index < len(layers) - 1:
            x = node({"relu": "Relu", "tanh": "Tanh"}[policy.activation], x)
    if policy.kind != "gaussian":
        x = node("Add", node("Tanh", x), constant(np.float64(1)))
        x = node("Add", node("Mul", x, constant((high - low) / 2)), constant(low))
    x = node("Min", node("Max", x, constant(low)), constant(high))
    node("Cast", x, output="actions", to=TensorProto.FLOAT)
    observations = helper.make_tensor_value_info("observations", TensorProto.DOUBLE, ["n", len(mean)])
    result = helper.make_tensor_value_info("actions", TensorProto.FLOAT, ["n", actions])
    graph = helper.make_graph(nodes, "policy", [observations], [result], constants)
    imports = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(graph, opset_imports=imports, producer_name="offbench", ir_version=IR_VERSION)
    helper.set_model_props(model, {"offbench": origin})
    checker.check_model(model)
    return bytes(model.SerializeToString())
