"""Taichi kernels on the CPU: the air of the halls, layers of servers, queues, airflow on a grid.

A kernel takes NumPy arrays and fills NumPy arrays; README.md says where to look first.
Kernels know no configuration and no fleet; what reaches into Taichi itself is in ``compiler``.
"""

import os

# Read when Taichi is imported and started: no header, and no question to the network.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "False")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")
