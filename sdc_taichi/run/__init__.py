"""Runs: a simulator under a controller for many steps, their totals, and the folder of a run.

Files of a run are defined here, and read back by ``sdc_taichi.viz``.
No physics, no controller and no picture lives here.
"""
