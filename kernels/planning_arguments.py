"""Arguments of the kernels of ``planning.py``. This module does not import Taichi."""

from .arguments import Argument

LOWEST_PEAK_SHARE = 0.5
"""Lowest trial peak, as a share of the largest energy of a step under neutral commands."""
NEGLIGIBLE_SHARE = 1e-10
"""Share of the cost that a stronger command must save to be chosen; less may be rounding."""
SECANT_TASKS = 10.0
"""Distance from the mean work, in tasks, for the secant slope of energy per task after the end."""
NO_PEAK_KWH = 1e30
"""Peak energy of a step that stands for no limit, in kWh."""

STEP_ROWS = {
    "weight": "cost of a kWh",
    "weather": "position of the wet bulb (or dry bulb) on the grid of the map",
    "depression": "position of dry bulb minus wet bulb on the grid of the map",
    "arrived": "work that arrives, in tasks",
    "flexible": "work that may be deferred, in tasks",
    "capacity": "work that the step can do, in tasks",
    "most_drained": "work that a command can take out of the queue, in tasks",
    "most_due": "due work that the step can do, in tasks",
    "not_due": "queue before the step that need not run in it, in tasks",
    "spacing": "spacing of the queue levels at the end of the step, in tasks",
}
"""Inputs of each coming step of a data center."""
QUEUE_ROWS = {
    "map": "number of the map",
    "setpoint": "position of the setpoint on the grid of the map",
    "limit": "longest queue, in tasks",
    "end_weight": "cost of a kWh after the end of the forecast",
    "mean_tasks": "mean of the work that arrives in a step, in tasks",
    "late_cost": "cost of a task that is late or dropped",
    "peak_kwh": "peak energy of a step of the month to date, in kWh",
    "peak_cost": "demand charge per kWh of the month's peak beyond peak_kwh",
}
"""Queue inputs of each data center."""
STORE_ROWS = {
    "spacing": "spacing of the levels of stored energy, in kWh",
    "charge_efficiency": "energy stored per energy drawn, without the square loss",
    "discharge_factor": "energy taken from the store per energy delivered, without the square loss",
    "square_per_kwh": "loss divided by the square of the energy that is converted, 1/kWh",
    "grid_limit": "maximum energy of a step from the grid, in kWh",
    "end_value": "value of a stored kWh at the end of the forecast",
    "peak_kwh": "peak energy of a step of the month to date, in kWh",
    "peak_cost": "demand charge per kWh of the month's peak beyond peak_kwh",
}
"""Battery inputs of each data center."""
_COMMON = {
    "serial": Argument("template"),  # True: run on the calling thread alone
    "slices": Argument("i32"),  # number of parts of the data centers, one thread each
    "size": Argument("i32"),  # number of data centers
    "horizon": Argument("i32"),  # number of steps of the forecast, next step first
    "levels": Argument("i32"),
    "peaks": Argument("i32"),  # number of trial peaks; 1 without a demand charge
    "commands": Argument("f64", 1),  # commands of later steps
    "cost": Argument("f64", 3),  # work space, (B, 2, levels)
    "chosen": Argument("i32", 1),  # index of the best first-step candidate, (B,)
    "facility_kwh": Argument("f64", 2),  # energy of the facility in each step, (B, H)
}
QUEUE_ARGUMENTS = {
    **_COMMON,
    "of_dc": Argument("f64", 1, rows=QUEUE_ROWS, of="dcs"),
    "coming": Argument("f64", 1, rows=STEP_ROWS, of="steps"),
    # Facility energy in kWh by map, weather, depression, setpoint and utilisation (evenly 0 to 1).
    "table": Argument("f64", 5),
    "policy": Argument("i32", 3),  # work space, (B, H, levels)
    "kwh": Argument("f64", 2),  # work space, energy in kWh by utilisation, (B, I)
    "first_executed": Argument("f64", 2),  # executed work of each candidate, in tasks, (B, C)
    "first_waiting": Argument("f64", 2),  # queue after each candidate, in tasks, (B, C)
    "first_late": Argument("f64", 2),  # dropped work of each candidate, in tasks, (B, C)
    "executed": Argument("f64", 2),  # executed work of each step of the plan, in tasks, (B, H)
}
"""Arguments of the kernel of ``queue_kernel``."""
STORE_ARGUMENTS = {
    **_COMMON,
    "of_dc": Argument("f64", 1, rows=STORE_ROWS, of="dcs"),
    "weight": Argument("f64", 2),  # cost of a kWh in each step, (B, H)
    # Limits of a step at each level: kWh that the battery can draw, kWh that it can deliver, and
    # the share of the facility's energy that it may deliver.
    "most_charge": Argument("f64", 2),
    "most_discharge": Argument("f64", 2),
    "load_share": Argument("f64", 2),
    "first_grid": Argument("f64", 2),  # grid energy of each candidate, in kWh, (B, C)
    "first_stored": Argument("f64", 2),  # stored energy after each candidate, in kWh, (B, C)
}
"""Arguments of the kernel of ``store_kernel``, which only reads ``facility_kwh``."""
