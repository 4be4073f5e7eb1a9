"""Kernel that limits the work that sites of a fleet send to each other (``sim/transfer.py``)."""

from functools import cache
from typing import Any, no_type_check

import taichi as ti

from .compiler.functions import SLICE

SERIAL_UP_TO = 128
"""Largest number of fleets that one thread computes faster than several."""
TASK_FLEETS = 16
"""Number of fleets that one task computes."""


@cache
def transfer_kernel() -> Any:
    """Return the kernel that computes feasible flows of work between the S sites of F fleets.

    What was asked is limited in one pass: shares by residency and to a sum of 1, then each link,
    what a site sends, and what its receiver can take. Feasible flows stay as they are.

    Arguments, after the two numbers arrays of f64:

    - serial: True if the calling thread does all work.
    - one: always 1, see "Loops of step 1" in README.md.
    - shares: share of the flexible work of a site (row) to send to each site, (F, S, S).
    - allowed: 1 where work may go, else 0, (F, S, S).
    - pair_limit: most work of each link, in tasks, (F, S, S).
    - site_limit: most work that a site sends, and that it gets, in tasks, (F, S).
    - flexible: work that may go, in tasks, (F, S).
    - room: work that each site can take, in tasks, (F, S).
    - flow: output, work that goes from site (row) to site (column), in tasks, (F, S, S).
    - totals: output, in tasks, (3, F, S): work sent, work that comes, and work that was to go but
      stays.
    """
    pairs = ti.types.ndarray(dtype=ti.f64, ndim=3)
    sites = ti.types.ndarray(dtype=ti.f64, ndim=2)

    @ti.kernel
    @no_type_check
    def transfer(
        serial: ti.template(),
        one: ti.i32,
        shares: pairs,
        allowed: pairs,
        pair_limit: pairs,
        site_limit: sites,
        flexible: sites,
        room: sites,
        flow: pairs,
        totals: pairs,
    ):
        n_tasks = (flow.shape[0] + (TASK_FLEETS - 1)) // TASK_FLEETS
        ti.loop_config(serialize=serial)
        for at in range(n_tasks * SLICE):
            if at % SLICE == 0:
                f = at // SLICE * TASK_FLEETS
                end = ti.min(f + TASK_FLEETS, flow.shape[0])
                n = flow.shape[1]
                while f < end:
                    s = 0
                    while s < n:
                        asked, total, d = ti.f64(0.0), ti.f64(0.0), 0
                        while d < n:
                            share = ti.min(ti.max(shares[f, s, d], 0.0), 1.0) * allowed[f, s, d]
                            flow[f, s, d] = share
                            total += share
                            d += one
                        scale, d = flexible[f, s] / ti.max(total, 1.0), 0
                        total = 0.0
                        while d < n:
                            wanted = flow[f, s, d] * scale
                            asked += wanted
                            flow[f, s, d] = ti.min(wanted, pair_limit[f, s, d])
                            total += flow[f, s, d]
                            d += one
                        if total > site_limit[f, s]:
                            scale, d = site_limit[f, s] / total, 0
                            while d < n:
                                flow[f, s, d] *= scale
                                d += one
                        totals[0, f, s] = 0.0
                        totals[2, f, s] = asked
                        s += one
                    d = 0
                    while d < n:
                        coming, s = ti.f64(0.0), 0
                        while s < n:
                            coming += flow[f, s, d]
                            s += one
                        most = ti.min(room[f, d], site_limit[f, d])
                        keep = ti.select(coming > most, most / ti.max(coming, 1e-300), 1.0)
                        got = ti.f64(0.0)
                        s = 0
                        while s < n:
                            moved = flow[f, s, d] * keep
                            flow[f, s, d] = moved
                            got += moved
                            totals[0, f, s] += moved
                            s += one
                        totals[1, f, d] = got
                        d += one
                    s = 0
                    while s < n:
                        totals[2, f, s] = ti.max(totals[2, f, s] - totals[0, f, s], 0.0)
                        s += one
                    f += one

    return transfer
