"""Simulate data centers in batches: workload, cooling, battery, carbon, and every server's air.

The public names are listed in ``__init__.pyi``.
"""

from importlib.metadata import version
from pathlib import Path

import lazy_loader
import wrapt

_PARENT = Path(__file__).parent.parent
if (_PARENT / "pyproject.toml").is_file():
    # In a checkout, configs, data, kernels and viz lie beside this folder. Without their parent in
    # the path they would be those of another checkout, if that one is installed.
    __path__.append(str(_PARENT))

from sdc_taichi.envs import register  # noqa: E402

__version__ = version("sdc-taichi")
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# Gymnasium takes much longer to import than the lines above, and many programs do without it.
wrapt.register_post_import_hook(register, "gymnasium")
