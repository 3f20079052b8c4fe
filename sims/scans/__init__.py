"""Worlds from meshes: scans, models of other programs, Gazebo's worlds."""
