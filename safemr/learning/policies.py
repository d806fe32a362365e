"""A trained policy: observation transform and network, saved as plain arrays.

``policy.npz`` holds no pickled object, so loading a stranger's policy runs no code. Besides the
policy it may hold what figures need from the run: the multiplier network and the energy
parameters (keys ``multiplier_*`` and ``zeta``).
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from safemr.errors import UserError
from safemr.files import POLICY, policy_arrays
from safemr.learning.interface import Interface
from safemr.learning.networks import ACTIVATIONS, StackedMLP
from safemr.learning.observation import ObservationTransform

Arrays = dict[str, NDArray]


def network_arrays(prefix: str, network: StackedMLP) -> Arrays:
    """Shape, activation and flat parameters of a network under ``prefix``."""
    return {
        f"{prefix}_sizes": np.array(network.shape.sizes, np.int64),
        f"{prefix}_activation": np.array(network.shape.activation),
        f"{prefix}_parameters": network.parameters.detach().cpu().numpy().copy(),
    }


def network_from_arrays(prefix: str, arrays: Mapping[str, NDArray]) -> StackedMLP:
    """The inverse of `network_arrays`, for a single (unstacked) network."""
    activation = str(arrays[f"{prefix}_activation"])
    if activation not in ACTIVATIONS:
        raise UserError(f"policy file: unknown activation {activation!r}, expected {ACTIVATIONS}")
    network = StackedMLP(1, [int(size) for size in arrays[f"{prefix}_sizes"]], activation)
    network.load(arrays[f"{prefix}_parameters"])
    return network


class Policy:
    """A stochastic policy over actions in [-1, 1]^A.

    ``squash``: the network gives mean and log standard deviation of a tanh-squashed Gaussian
    (the soft actor-critic family); otherwise it gives the mean of a Gaussian whose log standard
    deviation is ``log_std`` [A] and whose sample the environment clips (the on-policy family).
    ``interface`` is the one it was trained through: its actions are the environment's, already
    scaled, and each is to be held for ``action_repeat`` control steps.
    """

    def __init__(
        self,
        transform: ObservationTransform,
        network: StackedMLP,
        *,
        squash: bool,
        log_std: torch.Tensor | None = None,
        extras: Mapping[str, NDArray] | None = None,
        interface: Interface | None = None,
    ) -> None:
        self.transform, self.network = transform, network
        self.interface = interface or Interface()
        self.squash, self.log_std = squash, log_std
        self.extras = dict(extras or {})

    @property
    def action_repeat(self) -> int:
        """Control steps for which an action is to be held."""
        return self.interface.action_repeat

    @torch.no_grad()
    def act(
        self,
        observations: NDArray[np.floating],
        deterministic: bool = True,
        generator: torch.Generator | None = None,
    ) -> NDArray[np.float32]:
        """Actions float32 [N, A] for raw environment observations [N, obs], or [A] for one [obs].

        Raises UserError where the observations are not of the environment that this policy reads.
        """
        observations = np.asarray(observations)
        self.transform.check_width(observations)
        if observations.ndim == 1:
            return self.act(observations[None], deterministic, generator)[0]
        parameters = self.network.parameters
        inputs = torch.from_numpy(self.transform(observations)).to(parameters.device)
        output = self.network(inputs)[0]
        mean, log_std = output.chunk(2, -1) if self.squash else (output, self.log_std)
        if not deterministic:
            if log_std is None:
                raise ValueError("this policy has no standard deviation to sample with")
            noise = torch.randn(mean.shape, generator=generator).to(mean.device)
            mean = mean + log_std.exp() * noise
        actions = (mean.tanh() if self.squash else mean.clamp(-1.0, 1.0)).cpu().numpy()
        return self.interface.scaled(actions)

    def __call__(
        self, observations: NDArray[np.floating], deterministic: bool = True
    ) -> NDArray[np.float32]:
        """`act`."""
        return self.act(observations, deterministic)

    def arrays(self) -> Arrays:
        """Everything needed to act again, as arrays for `numpy.savez`."""
        arrays = {
            "squash": np.array(self.squash),
            "columns": self.transform.columns,
            "scale": self.transform.scale,
            "clip": self.transform.clip,
            **network_arrays("policy", self.network),
            **self.extras,
        }
        if self.log_std is not None:
            arrays["log_std"] = self.log_std.detach().cpu().numpy().copy()
        if self.transform.shift is not None:
            arrays["shift"] = self.transform.shift
            arrays["width"] = np.array(self.transform.width, np.int64)
        if self.transform.lidars:
            arrays["lidars"] = np.array(self.transform.lidars, np.int64)
            arrays["width"] = np.array(self.transform.width, np.int64)
        if self.action_repeat > 1:
            arrays["action_repeat"] = np.array(self.action_repeat, np.int64)
        if self.interface.action_scale:
            arrays["action_scale"] = np.array(self.interface.action_scale)
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray]) -> Policy:
        transform = ObservationTransform(
            arrays["columns"],
            arrays["scale"],
            arrays["clip"],
            int(arrays["width"]) if "width" in arrays else None,
            tuple(int(start) for start in arrays.get("lidars", ())),
            arrays.get("shift"),
        )
        interface = Interface(
            int(arrays.get("action_repeat", 1)), tuple(map(float, arrays.get("action_scale", ())))
        )
        log_std = torch.from_numpy(arrays["log_std"]) if "log_std" in arrays else None
        known = {
            *("squash", "columns", "scale", "clip", "log_std"),
            *("lidars", "width", "action_repeat", "action_scale", "shift"),
        }
        extras = {
            key: value
            for key, value in arrays.items()
            if key not in known and not key.startswith("policy_")
        }
        return cls(
            transform,
            network_from_arrays("policy", arrays),
            squash=bool(arrays["squash"]),
            log_std=log_std,
            extras=extras,
            interface=interface,
        )


def load_policy(path: str | PathLike[str]) -> Policy:
    """Reads ``policy.npz`` (or the record folder that holds it).

    Raises UserError when the file is missing, damaged or not a policy.
    """
    path = Path(path)
    if path.is_dir():
        path /= POLICY
    try:
        return Policy.from_arrays(policy_arrays(path))
    except (ValueError, KeyError) as error:
        raise UserError(f"{path}: not a policy file ({error}); retrain the run") from error
