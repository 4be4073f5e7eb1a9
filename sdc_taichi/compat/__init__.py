"""The interface of the released SustainDC class, for programs that were written for it.

``SustainDC`` takes the constructor keys of the released class and has its methods, observations and
infos. This package only translates between that interface and an environment with preset
``sustaindc``; it contains no physics. docs/coming-from-sustaindc.md describes the differences.
"""

from sdc_taichi.compat.environment import SustainDC

__all__ = ["SustainDC"]
