"""`export-policy`: a trained policy as TorchScript, which runs without offbench."""

# no `from __future__ import annotations` here: TorchScript reads the annotations of Actor
import io
import json
import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

from offbench.common.arrays import Array
from offbench.common.errors import OffbenchError
from offbench.common.files import output_file, write_bytes
from offbench.rollouts.policy import Policy, load_policy
from offbench.training.run import Run

ENDINGS = (".pt", ".pth", ".ts")
ACTIVATIONS = {"relu": nn.ReLU, "tanh": nn.Tanh}


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
        self.register_buffer("mean", _double(policy.observation_mean))
        self.register_buffer("std", _double(policy.observation_std))
        self.register_buffer("low", _double(policy.low))
        self.register_buffer("high", _double(policy.high))

    def forward(self, observations: Tensor) -> Tensor:
        """Return the actions."""
        out = self.network((observations.to(torch.float64) - self.mean) / self.std)
        squashed = torch.tanh(out[..., : self.actions])  # a Gaussian's other half is its log std
        scaled = self.low + (squashed + 1.0) * (self.high - self.low) / 2.0
        return torch.minimum(torch.maximum(scaled, self.low), self.high).to(torch.float32)


def _double(array: Array) -> Tensor:
    return torch.from_numpy(array.astype("float64"))


def export_policy(path: str | Path, out: str | Path) -> Path:
    """Write a run's policy, or a policy file, as TorchScript: `torch.jit.load(out)(observations)` acts.

    The file also holds where the policy comes from (`_extra_files`, "offbench.json").

    Raises:
        OffbenchError: there is no policy, it has no single best action, the file does not end in .pt, its folder does
            not exist, or it cannot be written.
    """
    source, target = Path(path), output_file(out)
    if target.suffix.lower() not in ENDINGS:
        raise OffbenchError(f"cannot write {target.name!r}: policies are exported as TorchScript; give --out FILE.pt")
    policy = load_policy(Run(source).policy_path if source.is_dir() else source)
    if policy.kind not in ("tanh", "squashed_gaussian"):
        reason = "chooses among random actions" if policy.kind == "best_by_q" else "is random"
        raise OffbenchError(f"{path} {reason} ({policy.kind}); only policies with one best action can be exported")
    data, origin = io.BytesIO(), {"env_id": policy.env_id, "kind": policy.kind, "origin": policy.origin}
    with warnings.catch_warnings():
        # deprecated, but every PyTorch since 1.0 reads it; files of torch.export need the version that wrote them
        warnings.simplefilter("ignore", DeprecationWarning)
        scripted = torch.jit.script(Actor(policy).eval())
        torch.jit.save(scripted, data, _extra_files={"offbench.json": json.dumps(origin)})
    write_bytes(target, data.getvalue())
    return target
