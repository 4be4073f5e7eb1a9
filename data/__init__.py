"""Embedded figures; README.md names their sources.

Those from which synthetic years are generated are read by ``sdc_taichi.exogenous.synthetic``, the
tables of the paper by ``sdc_taichi.benchmark.paper_accounting``.
No measured row lives here.
"""
