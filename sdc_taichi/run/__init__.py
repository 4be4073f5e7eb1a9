"""Runs: a simulator under a controller for many steps, their metrics, and the run folder.

The files of a run folder are defined here, written by ``folder_writer`` and read by
``folder_reader``. No physics, no controller and no picture lives here.
"""
