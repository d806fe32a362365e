"""A grid-free lower bound of the value, to judge the grid's solution by.

Any fixed sequence of turn rates can be flown, so the separation that the best of some sequences
keeps is a lower bound of V, exact up to rounding. With one switch it is nearly tight.
"""

from __future__ import annotations

import numpy as np

from envs.aircraft import AircraftDynamics
from safemr.aircraft.reachability.grid import Floats


def open_loop_value(
    dynamics: AircraftDynamics, states: Floats, horizon: float = 2.8, switches: int = 1
) -> Floats:
    """min over time of d - d_min under the best sequence with at most one switch, [N] for [N, 3].

    Turn rates are the extreme ones and zero, switching at multiples of dt; separations are taken
    at these times. Raises ValueError for traffic that reacts, where no sequence is a bound.
    """
    if len(dynamics.other_turns) != 1:
        raise ValueError("the open-loop bound needs traffic of constant turn rate")
    if switches not in (0, 1):
        raise ValueError(f"switches must be 0 or 1, not {switches}")
    b = dynamics.other_turns[0]
    rates = (-dynamics.turn_limit, 0.0, dynamics.turn_limit)
    steps = round(horizon / dynamics.dt)
    best = np.full(len(states), -np.inf)
    for first in rates:
        at_switch = states
        so_far = dynamics.separation(states)
        for step in range(steps + 1):
            # A sequence that never switches is the one whose second rate equals the first.
            for second in rates if switches and step else (first,):
                if second == first and step:
                    continue
                times = dynamics.dt * np.arange(1, steps - step + 1)[:, None]
                rest = dynamics.separation(dynamics.flow(at_switch, second, b, times))
                best = np.maximum(best, np.minimum(so_far, rest.min(axis=0, initial=np.inf)))
            at_switch = dynamics.flow(at_switch, first, b)
            so_far = np.minimum(so_far, dynamics.separation(at_switch))
    return best - dynamics.d_min
