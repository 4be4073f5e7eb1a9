"""Links and budgets of fleets of sites that share work, as arrays.

B data centers form F fleets of S sites each. Sites of a fleet are consecutive, so that an array
(B, S) is also (F, S, S): rows are senders, columns receivers of the same fleet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.config.fleet_schema import FleetConfig
from sdc_taichi.errors import ConfigError
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.types import F64


@dataclass(frozen=True, slots=True)
class SharedWork:
    """Links and budgets of F fleets of S sites, B = F S data centers."""

    allowed: F64
    """1 where work of a site (row) may go to a site of its fleet (column), else 0, (B, S)."""
    pair_tasks: F64
    """Most work that goes from site (row) to site (column) in a step, in tasks, inf for no limit,
    (B, S)."""
    site_tasks: F64
    """Most work that each site sends in a step, and most that it gets, in tasks, inf for no limit,
    (B,)."""
    delay_steps: int
    """Steps from the departure of work to its arrival."""
    power_limit_kw: F64
    """Budget of the power of each site's fleet, in kW, nan for none, (B,)."""
    power_limit_ratio: F64
    """Budget of the power of each site's fleet divided by its design power, nan for none, (B,)."""
    carbon_limit_g_per_h: F64
    """Budget of the emissions of each site's fleet, in g CO2e/h, nan for none, (B,)."""

    def fleet_sums(self, values: F64) -> F64:
        """Return the sum over its fleet for each site, (B,), of values of the sites, (B,)."""
        sites = self.allowed.shape[1]
        sums: F64 = np.repeat(values.reshape(-1, sites).sum(axis=1), sites)
        return sums

    def excess(self, values: F64, budget: F64) -> F64:
        """Return each site's part of its fleet's excess over a budget, (B,), by its share.

        Args:
            values: Values of the sites, at least 0, (B,).
            budget: Budget of each site's fleet, in the unit of the values, (B,); nan for none.
        """
        total = self.fleet_sums(values)
        excess = np.fmax(total - budget, 0.0)
        return np.asarray(excess * values / np.where(total > 0.0, total, 1.0))

    def power_kw(self, facility_w: F64) -> F64:
        """Return the budget of the power of each site's fleet, in kW, (B,); nan for none.

        Args:
            facility_w: Design power of each facility, in W, (B,).
        """
        by_ratio_kw = self.power_limit_ratio * self.fleet_sums(facility_w) / 1e3
        return np.where(np.isnan(self.power_limit_kw), by_ratio_kw, self.power_limit_kw)

    @property
    def link_tasks(self) -> F64:
        """Most work that each site can send in a step, in tasks, inf for no limit, (B,)."""
        pairs = np.where(self.allowed > 0.0, self.pair_tasks, 0.0).sum(axis=1)
        return np.asarray(np.minimum(self.site_tasks, pairs))


def shared_work(configs: Sequence[DataCenterConfig]) -> SharedWork | None:
    """Return links and budgets of fleets; None if the data centers are no whole fleets.

    Raises:
        ConfigError: Sites of a fleet or fleets do not fit together.
    """
    members = [config.fleet for config in configs if config.fleet is not None]
    if not members:
        return None
    if len(members) < len(configs):
        lone = next(config for config in configs if config.fleet is None)
        raise ConfigError(
            f"fleet: {lone.name} has no section fleet; valid is that all or no data centers have"
        )
    sites = len(members[0].sites)
    for config, member in zip(configs, members, strict=True):
        if (len(member.sites), member.delay_steps) != (sites, members[0].delay_steps):
            raise ConfigError(
                f"fleet: {config.name} has {len(member.sites)} sites and delay_steps "
                f"{member.delay_steps}, {configs[0].name} {sites} and {members[0].delay_steps}; "
                "valid are equal ones in all fleets"
            )
    whole = [place % sites for place in range(len(members))]
    if len(members) % sites or [member.place for member in members] != whole:
        return None
    for first in range(0, len(configs), sites):
        _check_fleet(configs[first : first + sites])
    # Copies of a fleet have equal links.
    links = {id(m): _links(m) for m in members[::sites]}
    of_fleets = [links[id(m)] for m in members[::sites]]
    return SharedWork(
        allowed=np.concatenate([_allowed(m) for m in members[::sites]]),
        pair_tasks=np.concatenate([pairs for pairs, _ in of_fleets]),
        site_tasks=np.repeat([site for _, site in of_fleets], sites),
        delay_steps=members[0].delay_steps,
        power_limit_kw=_values(members, "power_limit_kw"),
        power_limit_ratio=_values(members, "power_limit_ratio"),
        carbon_limit_g_per_h=_values(members, "carbon_limit_kg_per_day") * (1e3 / 24.0),
    )


def _check_fleet(configs: Sequence[DataCenterConfig]) -> None:
    """Check that the data centers of a fleet have one clock, and tasks of one size."""
    first = configs[0]
    assert first.fleet is not None
    for config in configs[1:]:
        assert config.fleet is not None
        for path, mine, others in (
            ("fleet", config.fleet.model_copy(update={"place": 0}), first.fleet),
            ("site.start", config.site.start, first.site.start),
            ("site.year", config.site.year, first.site.year),
            ("hall and servers", (config.hall, config.servers), (first.hall, first.servers)),
        ):
            if mine != others:
                raise ConfigError(
                    f"fleet: {path} of {config.name} differs from that of {first.name}; valid are "
                    "equal ones at all sites of a fleet"
                )


def _links(fleet: FleetConfig) -> tuple[F64, float]:
    """Return the limits of pairs of sites, (S, S), and of each site, in tasks per step."""
    sites, share = len(fleet.sites), fleet.link_share_per_hour
    if not isinstance(share, dict):
        limit = np.inf if share is None else share * TASKS_PER_STEP
        return np.full((sites, sites), np.inf), limit
    pairs = np.zeros((sites, sites))
    for name, of_pair in share.items():
        pair = fleet.pair_of(name)
        assert pair is not None
        pairs[pair] = of_pair * TASKS_PER_STEP
    return pairs, np.inf


def _allowed(fleet: FleetConfig) -> F64:
    """Return 1 for pairs of different sites of one residency group, else 0, (S, S)."""
    names = [name.upper() for name in fleet.sites]
    groups = [{name.upper() for name in group} for group in fleet.residency] or [set(names)]
    allowed = [
        [float(a != b and any(a in group and b in group for group in groups)) for b in names]
        for a in names
    ]
    return np.array(allowed)


def _values(members: Sequence[FleetConfig], name: str) -> F64:
    """Return a field of every data center's fleet, (B,); None becomes nan."""
    return np.array([getattr(member, name) for member in members], dtype=np.float64)
