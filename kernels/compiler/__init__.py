"""Functions that use Taichi beyond its public interface.

They start the runtime, launch kernels without Taichi's overhead, and compile plant equations. The
equations themselves are elsewhere. kernels/README.md lists each use of private interfaces, with its
gain.
"""
