"""Known optimum: a bound that no controller can beat, and a plan whose result is simulated.

The simulator tabulates the cost of each step by utilisation and setpoint. With this table the
control of a data center becomes a problem for linear and dynamic programming. The optimum of these
programmes bounds the objective of every controller, even one that knows all inputs in advance. The
simulator then runs a plan close to the optimum, which shows how much is achievable.
"""

from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.problem import StoppedError
from sdc_taichi.optimum.result import Optimum
from sdc_taichi.optimum.solve import solve

__all__ = ["Objective", "Optimum", "StoppedError", "solve"]
