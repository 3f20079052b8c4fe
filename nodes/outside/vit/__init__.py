"""Visual-inertial tracking libraries, as Basalt and OpenVINS are, by Monado's C interface."""

from nodes.outside.vit.node import Vit, VitConfig

__all__ = ["Vit", "VitConfig"]
