"""Causes of the junction temperature of a liquid-cooled rack: an exact sum over facility water."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sdc_taichi.errors import SdcError
from sdc_taichi.sim.liquid import Liquid

NO_JUNCTIONS = (
    "no rack has cold plates; valid is a hall with liquid-cooled chips, such as preset ai_hall_2026"
)
"""Message about the junctions of a hall without any."""
_SHOWN_K = 0.005
"""Smallest absolute value of a term that is shown although it may be zero, in K."""


@dataclass(frozen=True, slots=True)
class JunctionParts:
    """Terms whose sum is the junction temperature of a liquid-cooled rack at the end of a step."""

    rack: int
    """Index of the rack, counted from 0 in its data center."""
    junction_c: float
    """Junction temperature, in C: ``facility_c`` plus the other terms."""
    facility_c: float
    """Temperature of the facility water at the CDUs, in C."""
    setpoint_k: float
    """Setpoint of the coolant minus temperature of the facility water, in K."""
    shortfall_k: float
    """Coolant that reaches the rack minus its setpoint, in K: what the CDUs cannot cool."""
    power_k: float
    """Warming by the power of the GPUs without leakage, at design flow, in K."""
    flow_k: float
    """Further warming because the flow is not the design flow, in K."""
    leakage_k: float
    """Warming by the power that GPUs draw in addition to that at their reference temperature, in
    K."""
    limit_k: float
    """Cooling by throttling or a power cap, and lag of the chips behind their power, in K."""
    gpu_w: float
    """Power of a GPU without leakage, in W."""
    flow_share: float
    """Flow of coolant of the rack divided by its design flow."""
    is_off: bool
    """True if the rack has no power or has switched off."""
    cdus: int
    """Number of CDUs of the manifold of the rack."""
    cdus_up: int
    """Number of these CDUs that run."""
    valve: float
    """Mean opening of the valves of these CDUs, as a share of the design flow of facility water."""


def junction_parts(liquid: Liquid, indices: Mapping[int, int], rack: int | None) -> JunctionParts:
    """Split the junction temperature of a rack at the end of the last step.

    A GPU draws p = p0 (1 + leak (T_j - T_ref)), and T_j = T_coolant + R p at rest; R depends on the
    flow. With R_d at design flow and facility water of T_f the sum is

        T_j = T_f + (setpoint - T_f) + (T_coolant - setpoint)
              + R_d p0 + (R - R_d) p0 + R (p - p0) + limit.

    Args:
        liquid: Racks with coolant of a fleet, after a step.
        indices: Index among these of each liquid-cooled rack of a data center, by its index in the
            hall.
        rack: Index of the rack in the hall; None is that of the hottest junction.

    Raises:
        SdcError: The rack has no cold plates, or no rack has.
    """
    plates = liquid.fleet.has_plates
    of_plates = {place: index for place, index in indices.items() if plates[index]}
    if not of_plates:
        raise SdcError(NO_JUNCTIONS)
    if rack is None:
        rack = max(of_plates, key=lambda each: liquid.junction_c[of_plates[each]])
    if rack not in of_plates:
        raise SdcError(
            f"rack {rack}: has no cold plates; valid is a rack with cold plates, such as "
            f"{next(iter(of_plates))}"
        )
    values = liquid.values_of_rack(of_plates[rack])
    junction_c, coolant_c = values["junction_c"], values["supply_c"]
    facility_c, setpoint_c = values["water_supply_c"], values["wanted_c"]
    resistance = values["capture_chip"] * values["r_k_per_w"]
    design = values["r_fixed_k_per_w"] + values["r_film_k_m3s_per_w"] / values["design_m3s"]
    design *= values["capture_chip"]
    gpu_w = values["gpu_idle_w"] + values["gpu_span_w"] * values["utilisation"]
    gpu_w *= float(values["runs"] > 0.0)
    leakage_w = gpu_w * values["leak_per_k"] * (junction_c - values["leak_ref_c"])
    power_k, flow_k = design * gpu_w, (resistance - design) * gpu_w
    leakage_k = resistance * leakage_w
    return JunctionParts(
        rack=rack,
        junction_c=junction_c,
        facility_c=facility_c,
        setpoint_k=setpoint_c - facility_c,
        shortfall_k=coolant_c - setpoint_c,
        power_k=power_k,
        flow_k=flow_k,
        leakage_k=leakage_k,
        limit_k=junction_c - coolant_c - power_k - flow_k - leakage_k,
        gpu_w=gpu_w,
        flow_share=values["m3s"] / values["design_m3s"],
        is_off=values["runs"] == 0.0,
        cdus=int(values["cdus"]),
        cdus_up=int(values["cdus_up"]),
        valve=values["valve"],
    )


def junction_terms(parts: JunctionParts) -> list[tuple[str, float]]:
    """Return the terms of a junction with their texts: first facility water in C, then K each.

    Terms that are zero are omitted, except setpoint, power and leakage.
    """
    terms = [
        ("coolant setpoint above the facility water", parts.setpoint_k, True),
        ("coolant above its setpoint, which the CDUs do not reach", parts.shortfall_k, False),
        (f"GPUs of {parts.gpu_w:,.0f} W without leakage, at design flow", parts.power_k, True),
        (f"flow of {100 * parts.flow_share:.0f} % of design", parts.flow_k, False),
        ("leakage of the GPUs", parts.leakage_k, True),
        ("throttling or power cap, and lag of the chips", parts.limit_k, False),
    ]
    shown = [(text, k) for text, k, always in terms if always or abs(k) >= _SHOWN_K]
    return [("facility water", parts.facility_c), *shown]


def junction_state(parts: JunctionParts) -> str:
    """Return a sentence about the CDUs of the rack, and whether the rack is off."""
    valve = f"{100 * parts.valve:.0f} % of the design flow of facility water"
    text = f"{parts.cdus_up} of {parts.cdus} CDUs of its loop run, with {valve}"
    return f"the rack is off; {text}" if parts.is_off else text
