"""Air flow in a hall solved on a grid from its layout, for ``sdc-taichi hall solve``.

The result is a recirculation matrix that a configuration can name; the simulator never runs it.
Nothing here advances time or knows of a plant.
"""
