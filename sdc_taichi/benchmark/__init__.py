"""Benchmark suites of controllers, parameter sweeps, reports, and data sets for offline learning.

A suite compares controllers and training methods in the same weeks of the same data centers. A
sweep runs controllers on data centers that differ in chosen configuration fields. Both consist of
jobs: functions whose result depends only on plain values and input files, so that a job can run in
any process on any machine. Reports read the results of jobs from folders, including folders that
other people submit. ``offline.py`` records episodes of controllers as data sets.
"""
