"""One hall: where racks stand, whose exhaust they breathe, and the indices of its air.

Everything here works on one configuration or on plain arrays, without a simulator.
Time steps, batches of data centers and Taichi kernels never enter this folder.
"""
