"""Rotations between the axes conventions of optics, aviation, robotics and navigation.

Optical (OpenCV): x right, y down, z forward. FRD (aviation bodies): forward, right, down. FLU (bodies of ROS REP-103):
forward, left, up. ENU (the project's world): east, north, up. NED (aviation navigation): north, east, down.
"""

from __future__ import annotations

import numpy as np

from geometry.se3 import RigidTransform

FRD_FROM_OPTICAL = RigidTransform(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.zeros(3))
FLU_FROM_FRD = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
NED_FROM_ENU = RigidTransform(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.zeros(3))
