"""Known optimum: a bound on what any controller can reach, and a plan that the simulator has run.

A table of what each step costs, made by the simulator itself, turns the control of a data center
into linear programmes and dynamic programmes. Their optimum bounds the figure of every controller
that knows the inputs in advance; the plan behind it is then run to see what can be achieved.
"""

from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.problem import StoppedError
from sdc_taichi.optimum.result import Optimum
from sdc_taichi.optimum.solve import solve

__all__ = ["Objective", "Optimum", "StoppedError", "solve"]
