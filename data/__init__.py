"""Embedded figures from which synthetic years are generated; README.md names their sources.

They are read by ``sdc_taichi.exogenous.synthetic``.
No measured row lives here.
"""
