"""Solver for the airflow in a hall on a grid built from its layout (``sdc-taichi hall solve``).

The result is a recirculation matrix, to which a configuration can refer. The simulator never runs
this solver, and no function here advances time or uses a plant.
"""
