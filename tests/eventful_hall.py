"""Overrides of preset ``corrected`` for a small hall whose CRAC units often fail."""

EVENTFUL_HALL = [
    "hall.rows=2",
    "hall.racks_per_row=2",
    "hall.supply_approach_k=5",
    "hall.return_approach_k=-3",
    "servers.power_w=[300, 40]",
    "hvac.crac.units=2",
    "events.sampled=[{kind: crac_down, per_year: 2000, duration_h: [0.5, 1]}]",
]
