"""One hall: its floor plan, recirculation of exhaust air, placement of work, and air indices.

All functions here take one configuration or plain arrays and work without a simulator.
No function here steps through time, sizes a plant or runs a Taichi kernel.
"""
