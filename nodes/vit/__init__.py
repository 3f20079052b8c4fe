"""Visual-inertial tracking libraries, as Basalt and OpenVINS are, by Monado's C interface.

interface       the C interface, by ctypes
tracker         a library in a worker's process: what goes in, and the poses that come out
node            the estimator
"""

from nodes.vit.node import Vit, VitConfig

__all__ = ["Vit", "VitConfig"]
