"""Everything that reaches into Taichi beyond its public interface.

Starting the runtime, launching kernels without Taichi's overhead, and compiling plant equations.
No equation lives here; README.md says what each departure from the public interface gains.
"""
