"""The one place that imports Taichi, so that a maintained fork could take its place."""

import os

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "False")

import taichi as ti

__all__ = ["ti"]
