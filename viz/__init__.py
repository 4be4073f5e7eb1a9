"""Pictures, HTML reports and Rerun recordings of simulation results.

This package only draws what the simulator or a run folder contains. It computes no physics, and
the simulator never imports it.
"""
