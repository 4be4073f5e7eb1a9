"""Arguments of the kernels of ``planning.py``. This module imports no Taichi."""

from .arguments import Argument

LOWEST_PEAK_SHARE = 0.5
"""Lowest peak that is tried, over the highest energy of a step under neutral commands."""
NEGLIGIBLE_SHARE = 1e-10
"""Share of the cost that a stronger command has to save; less may be rounding."""
SECANT_TASKS = 10.0
"""Distance from the mean work at which the energy of a task after the end is measured."""
NO_PEAK_KWH = 1e30
"""Energy of a step that none exceeds."""

STEP_ROWS = {
    "weight": "cost of a kWh",
    "weather": "place of the wet bulb, or of the dry bulb, between the nodes of the map",
    "depression": "place of dry bulb less wet bulb between the nodes of the map",
    "arrived": "work that arrives, in tasks",
    "flexible": "work that may be deferred, in tasks",
    "capacity": "work that the step can do, in tasks",
    "most_drained": "work that a command can take out of the queue, in tasks",
    "most_due": "due work that the step can do, in tasks",
    "not_due": "most work in the queue before the step that need not run in it, in tasks",
    "spacing": "distance of levels of the queue at the end of the step, in tasks",
}
"""Inputs of each coming step of a data center."""
QUEUE_ROWS = {
    "map": "number of the map",
    "setpoint": "place of the setpoint between the nodes of the map",
    "limit": "longest queue, in tasks",
    "end_weight": "cost of a kWh after the end of the forecast",
    "mean_tasks": "mean of the work that arrives in a step, in tasks",
    "late_cost": "cost of a task that is late or dropped",
    "peak_kwh": "energy of a step that the month is charged for already",
    "peak_cost": "cost of each kWh of the month's peak beyond it",
}
"""Inputs of the queue of each data center."""
STORE_ROWS = {
    "spacing": "distance of levels, in kWh",
    "charge_efficiency": "energy stored per energy drawn",
    "discharge_factor": "energy taken from the store per energy delivered",
    "grid_limit": "most energy of a step from the grid, in kWh",
    "end_value": "value of a stored kWh at the end of the forecast",
    "peak_kwh": "energy of a step that the month is charged for already",
    "peak_cost": "cost of each kWh of the month's peak beyond it",
}
"""Inputs of the battery of each data center."""
_COMMON = {
    "serial": Argument("template"),  # on the calling thread alone
    "slices": Argument("i32"),  # parts of the data centers, each on one thread
    "size": Argument("i32"),  # data centers
    "horizon": Argument("i32"),  # steps of the forecast, the one to come first
    "levels": Argument("i32"),
    "peaks": Argument("i32"),  # peaks that are tried; 1 without a demand charge
    "commands": Argument("f64", 1),  # commands of later steps
    "cost": Argument("f64", 3),  # work space, (B, 2, levels)
    "chosen": Argument("i32", 1),  # candidate of the first step, (B,)
    "facility_kwh": Argument("f64", 2),  # energy of the facility in each step, (B, H)
}
QUEUE_ARGUMENTS = {
    **_COMMON,
    "of_dc": Argument("f64", 1, rows=QUEUE_ROWS, of="dcs"),
    "coming": Argument("f64", 1, rows=STEP_ROWS, of="steps"),
    # kWh by map, weather, depression, setpoint and utilisation, the last evenly from 0 to 1.
    "table": Argument("f64", 5),
    "policy": Argument("i32", 3),  # work space, (B, H, levels)
    "kwh": Argument("f64", 2),  # work space, energy by utilisation, (B, I)
    "first_executed": Argument("f64", 2),  # work that each candidate does, in tasks, (B, C)
    "first_waiting": Argument("f64", 2),  # queue that it leaves, in tasks, (B, C)
    "first_late": Argument("f64", 2),  # work that it drops, in tasks, (B, C)
}
"""Arguments of the kernel of ``queue_kernel``."""
STORE_ARGUMENTS = {
    **_COMMON,
    "of_dc": Argument("f64", 1, rows=STORE_ROWS, of="dcs"),
    "weight": Argument("f64", 2),  # cost of a kWh in each step, (B, H)
    # By level, in kWh: what a step can draw; what it can deliver, and at most of the facility's
    # energy.
    "most_charge": Argument("f64", 2),
    "most_discharge": Argument("f64", 2),
    "load_share": Argument("f64", 2),
    "first_grid": Argument("f64", 2),  # energy that each candidate buys, in kWh, (B, C)
    "first_stored": Argument("f64", 2),  # energy that it leaves stored, in kWh, (B, C)
}
"""Arguments of the kernel of ``store_kernel``; ``facility_kwh`` is read here."""
