"""Presets: one YAML file for each, complete or starting from another.

They are read by ``sdc_taichi.load_config``, which ``sdc_taichi.preset_names`` lists.
No code lives here.
"""
