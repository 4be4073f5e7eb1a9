"""The benchmark: suites of controllers and sweeps over data centers, as jobs that run anywhere.

A job is a function whose result depends on plain values and input files alone, so that it runs in
any process on any machine. A suite compares controllers, trained ones included, in the same weeks
of the same data centers. A sweep runs controllers on data centers that differ in chosen fields.
Reports read the results of jobs from folders, including those that other people submit. Episodes of
controllers become data sets for offline learning.
"""
