"""Other people's estimators: ORB-SLAM3, SVO, evalio's pipelines, libraries made for Monado.

Each has a licence of its own and runs in a process of its own, or in a library that it names.
"""
