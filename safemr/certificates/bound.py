"""A certificate where it applies: together with the distance that is to be kept on a task."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from safemr.certificates.certificate import Certificate
from safemr.errors import UserError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FARTHEST = 40.0  # of a drawing, in d_min


@dataclass(frozen=True)
class BoundCertificate:
    """A `Certificate` for one d_min [m]; ``certificate`` is the one without."""

    certificate: Certificate
    d_min: float

    @property
    def name(self) -> str:
        return self.certificate.name

    @property
    def parameters(self) -> Mapping[str, float]:
        """The numbers that phi has by name, lengths in units of ``length_scale``."""
        return self.certificate.parameters

    @property
    def eta(self) -> float:
        """eta_D of the constraint, in units of phi."""
        return self.certificate.eta

    @property
    def length_scale(self) -> float:
        """The unit of length in phi [m]."""
        return self.certificate.length_scale

    def phi(self, d: Any, d_dot: Any, observations: NDArray[Any] | None = None) -> Any:
        """phi [...], the largest over M obstacles, of d [m] and d_dot [m/s], both [..., M].

        A number is one obstacle: for phi over a line of distances [P] ask with ``d[:, None]``.
        ``observations`` [..., D] are the environment's, which only some families ask for. What is
        safe is phi <= 0. Raises UserError where the shapes do not fit.
        """
        d, d_dot = np.asarray(d, np.float64), np.asarray(d_dot, np.float64)
        if d.ndim == 0:
            d, d_dot = d[None], d_dot[None] if d_dot.ndim == 0 else d_dot
        try:
            d, d_dot = np.broadcast_arrays(d, d_dot)
        except ValueError:
            raise UserError(
                f"d has shape {d.shape} and d_dot {d_dot.shape}: give both one entry an obstacle"
            ) from None
        if self.certificate.observes and observations is None:
            raise UserError(f"phi of {self.name} asks for the observations: give them, too")
        return self.certificate.phi(d, d_dot, self.d_min, observations)

    def constraint(self, phi: Any, phi_next: Any) -> Any:
        """g [...] of phi before and after a decision, kept where g < 0 (Eq. cstr0)."""
        return self.certificate.constraint(np.asarray(phi), np.asarray(phi_next))

    def plot(self, ax: Axes | None = None, *, speed: float = 1.5, points: int = 201) -> Axes:
        """Draw phi over distance and its rate: shades, phi = 0 in black, grey within d_min.

        Rates lie between -``speed`` and half of it [m/s]. Without ``ax`` a new figure is made.
        Raises UserError for a phi that is not one of distance and rate alone.
        """
        from matplotlib.colors import TwoSlopeNorm

        if self.certificate.observes:
            raise UserError(
                f"phi of {self.name} asks for the observation, too: there is no plane to draw"
            )
        if ax is None:
            from matplotlib import pyplot as plt

            ax = plt.subplots()[1]
        d, rate = np.meshgrid(
            np.linspace(0, 1.15 * self._reach(speed), points),
            np.linspace(-speed, speed / 2, points),
        )
        phi = self.phi(d[..., None], rate[..., None])
        low, high = min(float(phi.min()), -1e-9), max(float(phi.max()), 1e-9)
        image = ax.contourf(
            d, rate, phi, levels=24, cmap="RdBu_r", norm=TwoSlopeNorm(0.0, low, high)
        )
        image.set_edgecolor("face")
        ax.contour(d, rate, phi, levels=[0.0], colors="k", linewidths=1.3)
        ax.axvspan(0, self.d_min, fc="0.35", alpha=0.55, lw=0)
        ax.axhline(0, color="0.4", lw=0.5)
        ax.set(xlabel="distance $d$ (m)", ylabel=r"rate $\dot d$ (m/s)", title=self.name)
        ax.set(xlim=(0, float(d.max())))
        ax.grid(False)
        ax.figure.colorbar(image, ax=ax, pad=0.02).set_label(r"energy $\phi$")
        return ax

    def _reach(self, speed: float) -> float:
        """The least distance [m] beyond which phi < 0 at this closing speed, in steps of d_min."""
        distances = self.d_min * np.arange(1.0, FARTHEST)
        unsafe = self.phi(distances[:, None], -speed) > 0
        return float(distances[min(len(distances) - 1, int(unsafe.sum()))])
