"""Methods of AirSim's and Cosys-AirSim's that are refused, and why."""

from __future__ import annotations

import re

_ABSENT = {
    r"sim\w*Detection\w*|simGetDetections": "make boxes of the segmentation image instead",
    r"sim\w*(Lens|Filmback|Foc|CurrentFieldOfView)\w*": "cameras are ideal or have the lens of the "
    "run's file; simSetCameraFov sets the field of view",
    r"simSwapTextures|simSetObjectMaterial\w*": "a world's textures are those of its file",
    r"simCreateVoxelGrid": "a server writes no files for its clients",
    r"moveByManual|moveByRC": "there is no remote control",
    r"setSafety": "there are no safety checks",
    r"setCarControls|getCarState|getCarControls": "there are no cars",
    r"simSetExtForce": "there are no external forces but the wind",
    r"get(Echo|UWB|Wifi|GPULidar)\w*|sim\w*(Echo|UWB|Wifi|GPULidar)\w*": "there is no such sensor",
    r"sim\w*Annotation\w*": "there are no annotation layers; use the segmentation image",
    r"sim\w*InstanceSegmentation\w*": "use simSetSegmentationObjectID and the segmentation image",
}


def reason_of_absence(method: str) -> str:
    """Return why a method is not there although AirSim has it; empty if AirSim has none either."""
    for pattern, reason in _ABSENT.items():
        if re.fullmatch(pattern, method):
            return reason
    return ""
