"""One hall: its floor plan, recirculation of exhaust air, placement of work, and air indices.

Everything here works on one configuration or on plain arrays, without a simulator.
Nothing here steps through time, sizes a plant or runs a Taichi kernel.
"""
