"""Simulate batches of data centers: workload, cooling, battery, carbon, and the air of each server.

``__init__.pyi`` lists the public names.
"""

from importlib.metadata import version
from pathlib import Path

import lazy_loader
import wrapt

_PARENT = Path(__file__).parent.parent
if (_PARENT / "pyproject.toml").is_file():
    # In a checkout, the folders configs, data, kernels and viz are siblings of this folder. Their
    # parent must be in the package's path: otherwise Python could import them from another
    # checkout that is installed.
    __path__.append(str(_PARENT))

from sdc_taichi.envs import register  # noqa: E402

__version__ = version("sdc-taichi")
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# Environments are registered when Gymnasium is imported, not here, because importing it is slow and
# many programs do not need it.
wrapt.register_post_import_hook(register, "gymnasium")
