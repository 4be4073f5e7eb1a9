"""The simulator: arrange configurations as flat arrays and run each step through all stages.

The package contains all code that carries state, batches data centers or calls Taichi kernels.
The equations of devices are in ``plant``; files are written by ``run`` and plots by ``viz``.
"""
