"""What the odometries share: images, optical flow, poses from landmarks, relocalization.

Plain functions on arrays, made for worker processes: no asyncio, and no node. The odometries
themselves are `nodes.estimators.visual_odometry` (a camera with depth) and
`nodes.estimators.monocular_odometry`.
"""
