"""Schema of a fleet of data centers that share work: sites, links between them, and budgets."""

from __future__ import annotations

from collections import Counter
from typing import Annotated, Self

from pydantic import Field, model_validator

from sdc_taichi.config.fields import Name, Section, Share


class FleetConfig(Section):
    """Sites that send flexible work to each other; each gets a data center of this configuration.

    Sites share a clock in UTC: a run begins at 0:00 UTC of ``site.start``.
    """

    sites: Annotated[tuple[Name, ...], Field(min_length=2)]
    """Names of the sites, at least 2, each once (see ``sdc-taichi data list``)."""
    link_share_per_hour: Share | dict[str, Share] | None = 0.1
    """Most work that a site sends in an hour, and most that it gets, as a share of the work that
    it can run in an hour, 0..1. A mapping such as {AZ-WA: 0.1, WA-AZ: 0.05} limits the links from
    one site to another instead, and sites without an entry are not linked. None means no limit."""
    delay_steps: Annotated[int, Field(ge=1, le=1440)] = 1
    """Steps from the departure of work to its arrival, 1..1,440 (a day of one-minute steps)."""
    transfer_energy_ratio: Annotated[float, Field(ge=0, le=100)] = 0.06
    """Energy of a transfer divided by the facility energy of the work, 0..100, with the PUE of the
    design point; assumed, as links use 0.06 kWh/GB or less (Aslan et al. 2018)."""
    transfer_kwh_per_task: Annotated[float, Field(ge=0, le=1e6)] | None = None
    """Energy of a transfer in kWh per task, 0..1e6; None uses ``transfer_energy_ratio``."""
    residency: tuple[tuple[Name, ...], ...] = ()
    """Groups of sites that work may not leave, each of at least 2 sites; none means one group."""
    power_limit_kw: Annotated[float, Field(ge=0, le=1e9)] | None = None
    """Budget of the power that all sites draw together, in kW, 0..1e9, for the cost
    ``fleet_power``; None uses ``power_limit_ratio``."""
    power_limit_ratio: Annotated[float, Field(ge=0, le=100)] | None = None
    """Budget of the fleet's power divided by the design power of its facilities, 0..100; None
    means no budget."""
    carbon_limit_kg_per_day: Annotated[float, Field(ge=0, le=1e9)] | None = None
    """Budget of the emissions of all sites in a day, in kg CO2e, 0..1e9, for the cost
    ``fleet_carbon``; None means no budget."""
    place: Annotated[int, Field(ge=0, le=10_000_000)] | None = None
    """Index in ``sites`` of the data center that this configuration describes; None describes the
    whole fleet."""

    @model_validator(mode="after")
    def _names_sites(self) -> Self:
        sites = [name.upper() for name in self.sites]
        twice = [name for name, count in Counter(sites).items() if count > 1]
        if twice:
            raise ValueError(f"sites names {twice[0]} twice; valid is each site once")
        if isinstance(self.link_share_per_hour, dict):
            self._check_pairs([*self.link_share_per_hour])
        if self.residency:
            self._check_groups(sites)
        if self.place is not None and self.place >= len(sites):
            raise ValueError(f"place {self.place}: valid is 0..{len(sites) - 1}, or null")
        return self

    def _check_pairs(self, names: list[str]) -> None:
        for name in names:
            if self.pair_of(name) is None:
                raise ValueError(
                    f"link_share_per_hour names {name!r}; valid is SITE-SITE of two different "
                    f"sites of {', '.join(self.sites)}"
                )

    def _check_groups(self, sites: list[str]) -> None:
        grouped = [name.upper() for group in self.residency for name in group]
        for name in grouped:
            if name not in sites:
                raise ValueError(f"residency names {name!r}; valid is one of {', '.join(sites)}")
        small = [group[0] for group in self.residency if len(group) == 1]
        alone = [name for name in sites if name not in grouped] + small
        if alone:
            raise ValueError(
                f"residency leaves {alone[0]} alone; valid is every site in a group of at least 2"
            )
        if len(set(grouped)) < len(grouped) or not all(self.residency):
            raise ValueError("residency: valid is every site in exactly one group of at least 2")

    def pair_of(self, name: str) -> tuple[int, int] | None:
        """Return sender and receiver of a link such as AZ-WA as indices in ``sites``.

        The result is None if the text does not name two different sites.
        """
        index = {site.upper(): i for i, site in enumerate(self.sites)}
        parts = name.upper().split("-")
        for cut in range(1, len(parts)):
            sender, receiver = ("-".join(part) for part in (parts[:cut], parts[cut:]))
            if sender in index and receiver in index and sender != receiver:
                return index[sender], index[receiver]
        return None
