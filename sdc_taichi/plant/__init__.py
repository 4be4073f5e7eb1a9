"""Equations of devices, from servers and CRAC units to the battery, as pure functions over arrays.

A function here takes arrays whose first axis is the data center and returns arrays of that shape.
It holds no state, reads no configuration, and branches on no value, so that it also runs compiled.
"""
