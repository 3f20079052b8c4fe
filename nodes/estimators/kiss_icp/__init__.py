"""KISS-ICP as an estimator on a lidar: an extra.

`settings` has its settings, `process` runs the library in a worker, `node` is the node.
"""

from nodes.estimators.kiss_icp.node import KissIcp, KissIcpConfig

__all__ = ["KissIcp", "KissIcpConfig"]
