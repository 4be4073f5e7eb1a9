"""Sites of a fleet in the order of their carbon intensity, as agents of transfers see them."""

from __future__ import annotations

import numpy as np

from sdc_taichi.control.view import View
from sdc_taichi.types import F64, I64


def cleaner_first(view: View) -> I64:
    """Return the other sites of each site's fleet, that with the cleanest grid now first.

    Returns:
        Indices of sites in their fleet, (B, S - 1).
    """
    sites = view.fleet.sites_per_fleet
    order = np.argsort(view.now.ci_g_per_kwh.reshape(-1, sites), axis=1, kind="stable")
    of_each = np.repeat(order, sites, axis=0)
    is_other = of_each != np.tile(np.arange(sites), len(order))[:, None]
    return np.asarray(of_each[is_other].reshape(-1, sites - 1))


def shares_of_sites(shares: F64, view: View) -> F64:
    """Return shares of work to send to each site of the fleet, (B, S), in the order of the sites.

    Args:
        shares: shares for the other sites, that with the cleanest grid first, (B, S - 1).
        view: the view before the step.
    """
    of_sites = np.zeros((view.size, view.fleet.sites_per_fleet))
    np.put_along_axis(of_sites, cleaner_first(view), shares, axis=1)
    return of_sites
