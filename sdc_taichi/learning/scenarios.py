"""Scenarios: data centers, actions and rewards that go together, by name.

A scenario is a set of settings of a training, in the form of ``TrainingSettings``, beneath those
that the user gives.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

SITES = ("AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA")
"""Sites of all scenarios."""
_FLEXIBLE = {
    "workload": {"flexible_share": 0.4, "queue_limit_h": 5.0},
    "battery": {
        "hours_of_design_load": 4.0,
        "charge_limit_c_rate": 0.25,
        "discharge_limit_c_rate": 0.25,
    },
}
"""Twice the work that may wait, and a battery of four hours."""
_BILL = {"actions": "continuous", "rewards": "bill"}
SCENARIOS: Mapping[str, Mapping[str, Any]] = {
    "carbon": {"sites": SITES},
    "carbon-rich": {"sites": SITES, "overrides": _FLEXIBLE},
    "bill": {"sites": SITES, "environment": _BILL, "validation": {"objective": "cost"}},
    "bill-rich": {
        "sites": SITES,
        "overrides": _FLEXIBLE,
        "environment": _BILL,
        "validation": {"objective": "cost"},
    },
}
"""Settings of each scenario, all of preset ``corrected``: the carbon of the hall as it is, the same
with twice the work that may wait and a battery of four hours, and of both the electricity bill,
which is energy by time of use and a demand charge."""
