"""One hall: where racks stand, whose exhaust they breathe, and the indices of its air.

Everything here works on one configuration or on plain arrays, without a simulator.
Nothing here steps through time, sizes a plant or runs a Taichi kernel.
"""
