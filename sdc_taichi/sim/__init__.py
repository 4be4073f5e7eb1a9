"""The simulator: configurations become flat arrays, and one step passes through all stages.

Whatever carries state, batches data centers or calls Taichi kernels for them lives here.
Equations of devices are in ``plant``, files and pictures in ``run`` and ``viz``, never here.
"""
