"""Equations of devices, from servers and CRAC units to the battery, as pure functions of arrays.

Each function takes and returns arrays of shape (B,), with B data centers along the first axis.
It holds no state, reads no configuration, and has no branch that depends on an array's values, so
a compiler can translate it unchanged.
"""
