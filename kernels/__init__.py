"""Taichi kernels on the CPU: the air of the halls, layers of servers, queues, airflow on a grid.

A kernel reads and writes NumPy arrays, and does not depend on configurations or fleets. README.md
says where to start reading. Code that uses Taichi's private interfaces is in ``compiler``.
"""

import os

# Taichi reads these variables on import: print no header, and check no version online.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "False")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")
