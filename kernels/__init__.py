"""Taichi kernels of sdc-taichi; they import nothing of the package and start no runtime."""
