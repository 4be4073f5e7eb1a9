"""Everything that reaches into Taichi beyond its public interface.

Starting the runtime, launching kernels without Taichi's overhead, and compiling plant equations.
No equation lives here; kernels/README.md says what each departure from the public interface gains.
"""
