"""Reconstructions as OpenSfM writes them."""

from scipy.spatial.transform import Rotation

from tests.captures.poses.pose_factory import FLIP, ring

PERSPECTIVE = {
    "projection_type": "perspective",
    "width": 640,
    "height": 480,
    "focal": 0.8,
    "k1": 0.1,
    "k2": -0.05,
}
BROWN = {
    "projection_type": "brown",
    "width": 480,
    "height": 640,
    "focal_x": 0.8,
    "focal_y": 0.75,
    "c_x": 0.01,
    "c_y": -0.02,
    "k1": 0.1,
    "k2": -0.05,
    "k3": 0.0,
    "p1": 0.001,
    "p2": 0.002,
}


def world_to_camera(pose):
    rotation = (pose[:, :3] @ FLIP).T
    return rotation, -rotation @ pose[:, 3]


def as_json(rotation, translation):
    return {
        "rotation": Rotation.from_matrix(rotation).as_rotvec().tolist(),
        "translation": translation.tolist(),
    }


def reconstruction(camera=PERSPECTIVE):
    shots = {name: {**as_json(*world_to_camera(pose)), "camera": "c"} for name, pose in ring().items()}
    points = {"7": {"coordinates": [1.0, 2.0, 3.0], "color": [36.0, 25.4, 300.0]}}
    return {"cameras": {"c": camera}, "shots": shots, "points": points}
