"""Runs of a simulator under a controller, their metrics, and the files of run folders.

``folder_writer`` writes run folders and ``folder_reader`` reads them. The package contains no
physics, no controllers and no plots.
"""
