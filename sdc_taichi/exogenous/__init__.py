"""Weather, grid carbon intensity and workload: embedded synthetic years, and the user's files.

These modules read and check all data from outside the data center, and resample them to the time
step of a simulation. They do not model the data center itself.
"""

from sdc_taichi.exogenous.carbon import read_carbon
from sdc_taichi.exogenous.psychrometrics import standard_pressure_pa, stull_wet_bulb_c, wet_bulb_c
from sdc_taichi.exogenous.registry import (
    load_site,
    load_trace,
    site_from_files,
    site_names,
    site_pressure_pa,
    trace_names,
)
from sdc_taichi.exogenous.series import Series, SiteData, Weather, resample, statistics
from sdc_taichi.exogenous.synthetic import synthetic_site, synthetic_trace
from sdc_taichi.exogenous.weather import read_epw
from sdc_taichi.exogenous.workload import read_workload

__all__ = [
    "Series",
    "SiteData",
    "Weather",
    "load_site",
    "load_trace",
    "read_carbon",
    "read_epw",
    "read_workload",
    "resample",
    "site_from_files",
    "site_names",
    "site_pressure_pa",
    "standard_pressure_pa",
    "statistics",
    "stull_wet_bulb_c",
    "synthetic_site",
    "synthetic_trace",
    "trace_names",
    "wet_bulb_c",
]
