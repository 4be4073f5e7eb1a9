"""Modes of steady air: a few temperature patterns of which all steady states of a hall are made.

The steady states of a hall at any evenly spread load lie close to a space of few dimensions. Its
basis, the modes, is built from computed steady states by the empirical interpolation method
(Barrault, Maday, Nguyen and Patera 2004, *An empirical interpolation method: application to
efficient reduced-basis discretization of partial differential equations*, C. R. Math. 339(9)). Each
mode has a pattern of outlets and the pattern of exhaust mixes that follows from it. The outlets of
as many sampled racks as there are modes determine the amounts of all modes. The sampled racks
therefore form a small hall by themselves, whose steady state gives that of the large hall.

Worked example: in the first state the outlets of three racks are 8, 10 and 6 K above supply air.
The largest is that of rack 1, which is sampled, and mode 1 is (0.8, 1, 0.6). In the second state
the outlets are 8, 9 and 5 K; 9 times mode 1 leaves (0.8, 0, -0.4). Rack 0 is sampled, and mode 2 is
(1, 0, -0.5). In any other state, the outlets of racks 0 and 1 give the amounts of both modes, and
these give the outlet of rack 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.types import F64, I64, Reals

NEGLECTED_K = 5e-5
"""Largest difference between a steady state and its modes, in K; it is a quarter of the tolerance
of the sweeps in f32."""


@dataclass(frozen=True, slots=True)
class SteadyModes:
    """K modes of the steady states of a hall of R racks, and K sampled racks."""

    outlet_k: F64
    """Outlet minus supply temperature of each rack in each mode, in K, (K, R)."""
    mix_k: F64
    """Exhaust mix minus supply temperature of each rack in each mode, in K, (K, R)."""
    racks: I64
    """Racks that are sampled, one for each mode, (K,)."""
    amounts_per_k: F64
    """Amount of each mode per kelvin of outlet minus supply temperature of each sampled rack,
    in 1/K, (modes, sampled racks)."""

    @property
    def sample_weights(self) -> F64:
        """Weights of the sampled racks' exhausts in their exhaust mixes, (K, K).

        Row j holds the mix before sampled rack j; the weights of a row sum to about 1, and some
        may be negative.
        """
        return np.asarray(self.mix_k[:, self.racks].T @ self.amounts_per_k)


def extended_modes(
    before: SteadyModes | None, outlet_k: Reals, mix_k: Reals, most: int
) -> SteadyModes:
    """Extend the modes of a hall so that they also represent n further steady states.

    Args:
        before: Modes so far; None if there are none.
        outlet_k: Outlet minus supply temperatures of each state, in K, (n, R).
        mix_k: Exhaust mix minus supply temperatures of each state, in K, (n, R).
        most: Largest number of modes.
    """
    outlet_k, mix_k = outlet_k.copy(), mix_k.copy()
    modes = (
        [] if before is None else [*zip(before.racks, before.outlet_k, before.mix_k, strict=True)]
    )
    for mode in modes:
        _subtract(mode, outlet_k, mix_k)
    while len(modes) < most:
        largest_k = np.max(np.abs(outlet_k), axis=1, initial=0.0)
        state = int(np.argmax(largest_k)) if len(largest_k) else 0
        if not len(largest_k) or not largest_k[state] > NEGLECTED_K:
            break
        rack = int(np.argmax(np.abs(outlet_k[state])))
        scale = float(outlet_k[state, rack])
        modes.append((rack, outlet_k[state] / scale, mix_k[state] / scale))
        _subtract(modes[-1], outlet_k, mix_k)
    racks = np.array([rack for rack, _, _ in modes], dtype=np.int64)
    shape = len(modes), outlet_k.shape[1]
    outlet_modes = np.array([outlet for _, outlet, _ in modes], dtype=np.float64).reshape(shape)
    return SteadyModes(
        outlet_k=outlet_modes,
        mix_k=np.array([mix for _, _, mix in modes], dtype=np.float64).reshape(shape),
        racks=racks,
        amounts_per_k=np.asarray(np.linalg.inv(outlet_modes[:, racks].T), dtype=np.float64),
    )


def _subtract(mode: tuple[int, Reals, Reals], outlet_k: Reals, mix_k: Reals) -> None:
    """Subtract from all states the amount of a mode that their outlet at its rack determines."""
    rack, outlet, mix = mode
    for i, amount in enumerate(outlet_k[:, rack].copy()):
        outlet_k[i] -= amount * outlet
        mix_k[i] -= amount * mix
