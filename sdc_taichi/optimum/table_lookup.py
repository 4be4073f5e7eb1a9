"""Reading tables of a facility between their nodes."""

from __future__ import annotations

import numpy as np

from sdc_taichi.hall.protection import Mask
from sdc_taichi.optimum.problem import FacilityTable
from sdc_taichi.types import F64, I64

INLET_MARGIN_K = 0.02
"""By how much paths stay below the limit of inlets and bounds go beyond it, in K: inlets are not
quite linear between the utilisations of a table."""


def at_utilisation(values: F64, nodes: F64, utilisation: F64) -> F64:
    """Values of a table at a utilisation of each step, linear between the nodes, (T, J).

    Args:
        values: Values by step, utilisation and setpoint, (T, I, J).
        nodes: Utilisations of the table, rising, (I,).
        utilisation: Utilisation of each step, (T,); beyond the nodes that of the last node counts.
    """
    low, share = _place(nodes, utilisation)
    step = np.arange(len(utilisation))
    return _between(values[step, low], values[step, low + 1], share[:, None])


def energy_at_utilisation(values: F64, nodes: F64, utilisation: F64) -> F64:
    """Energy of a table at a utilisation of each step, cubic between the nodes, (T, J).

    Args:
        values: Energy by step, utilisation and setpoint, in kWh, (T, I, J).
        nodes: Utilisations of the table, rising, (I,).
        utilisation: Utilisation of each step, (T,); beyond the nodes that of the last node counts.
    """
    columns = [cubic(nodes, values[:, :, j], utilisation) for j in range(values.shape[2])]
    return np.stack(columns, axis=1)


def cubic(nodes: F64, values: F64, at: F64) -> F64:
    """Values of each step from the cubic through four nodes, (T,).

    Args:
        nodes: Places of the nodes, rising, (I,).
        values: Values of each step at them, (T, I).
        at: Place of each step, (T,); beyond the nodes that of the last node counts.
    """
    at = np.clip(at, nodes[0], nodes[-1])
    points = min(4, len(nodes))
    first = np.clip(np.searchsorted(nodes, at) - points // 2, 0, len(nodes) - points)
    x = nodes[first[:, None] + np.arange(points)]
    y = np.take_along_axis(values, first[:, None] + np.arange(points), axis=1)
    found = np.zeros(len(at))
    for k in range(points):
        others = np.delete(x, k, axis=1)
        share = (at[:, None] - others) / (x[:, k : k + 1] - others)
        found += y[:, k] * share.prod(axis=1)
    return found


def at_setpoint(values: F64, nodes: F64, setpoint_c: F64) -> F64:
    """Values at setpoints, linear between the nodes, (...).

    Args:
        values: Values by setpoint, (..., J).
        nodes: Setpoints of the table, rising, in C, (J,).
        setpoint_c: Setpoints, in C, of a shape that broadcasts to (...); beyond the nodes that of
            the last node counts.
    """
    if len(nodes) == 1:
        return values[..., 0].copy()
    low, share = _place(nodes, setpoint_c)
    below, above = (
        np.take_along_axis(values, k[..., None], axis=-1)[..., 0] for k in (low, low + 1)
    )
    return _between(below, above, share)


def facility_kwh(table: FacilityTable, utilisation: F64, setpoint_c: F64) -> F64:
    """Energy of the facility in each step, in kWh, (T,).

    Args:
        table: What steps cost.
        utilisation: Utilisation of each step, (T,).
        setpoint_c: Setpoint of each step, in C, (T,).
    """
    by_setpoint = energy_at_utilisation(table.facility_kwh, table.utilisation, utilisation)
    return at_setpoint(by_setpoint, table.setpoint_c, setpoint_c)


def barred(inlet_max_c: F64, unmet_w: F64, limit_c: float) -> Mask:
    """Whether a plan may not use a setpoint, (..., J).

    Where no setpoint keeps inlets within the limit, those with the coolest inlets may be used, and
    where none meets the cooling load, those that miss the least of it.

    Args:
        inlet_max_c: Hottest inlet by setpoint, in C, (..., J).
        unmet_w: Cooling load that stays in the room by setpoint, in W, (..., J).
        limit_c: Highest inlet, in C; inf without a limit.
    """
    within = inlet_max_c <= np.maximum(limit_c, coolest_inlet_c(inlet_max_c, unmet_w))
    return np.asarray(~(_meets(unmet_w) & within))


def coolest_inlet_c(inlet_max_c: F64, unmet_w: F64) -> F64:
    """Least of the hottest inlets over setpoints that miss the least of the cooling load, (..., 1).

    Args:
        inlet_max_c: Hottest inlet by setpoint, in C, (..., J).
        unmet_w: Cooling load that stays in the room by setpoint, in W, (..., J).
    """
    return np.asarray(np.where(_meets(unmet_w), inlet_max_c, np.inf).min(axis=-1, keepdims=True))


def _meets(unmet_w: F64) -> Mask:
    """Setpoints that miss the least of the cooling load, (..., J)."""
    return np.asarray(unmet_w <= unmet_w.min(axis=-1, keepdims=True))


def _between(low: F64, high: F64, share: F64) -> F64:
    """Values part of the way from low to high ones, of which one that is not reached may be inf."""
    below, above = np.where(share < 1.0, low, 0.0), np.where(share > 0.0, high, 0.0)
    return np.asarray(below * (1.0 - share) + above * share)


def _place(nodes: F64, at: F64) -> tuple[I64, F64]:
    """Node below each place, and how far it is to the node above, 0..1."""
    low = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    share = (at - nodes[low]) / (nodes[low + 1] - nodes[low])
    return low, np.clip(share, 0.0, 1.0)
