"""Presets, one YAML file each; ``sdc_taichi.load_config`` reads them by name."""
