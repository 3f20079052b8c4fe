"""SVO as an estimator: an extra, since it is under the GPL.

`settings` has its settings, `process` runs the library in a worker, `node` is the node.
"""

from nodes.estimators.svo.node import Svo, SvoConfig

__all__ = ["Svo", "SvoConfig"]
