"""Poses of LLFF as its programs write them."""

import numpy as np


def table(poses, hwf=(480.0, 640.0, 500.0)):
    rows = []
    for pose in poses:
        right, up, back, position = pose.T
        rows.append([*np.column_stack([-up, right, back, position, hwf]).ravel(), 0.5, 9.0])
    return np.array(rows)
