"""The benchmark: suites of controllers and sweeps over data centers, as jobs that run anywhere.

A job is a function of plain values whose result depends on nothing else, so it runs in any process
and on any machine, and its result is kept under what decides it. A suite compares controllers,
trained ones among them, on the same weeks of the same data centers; a sweep runs a controller on
data centers that differ in chosen fields. Reports read what jobs have left in folders, and so take
in the results of others. Episodes of controllers become data sets for offline learning.
"""
