from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from tests.captures.poses.alignment import align_poses, elsewhere
from tests.captures.poses.pose_factory import ring_set


def test_an_error_of_one_camera_is_told_in_its_pixels_and_degrees():
    truth = ring_set(20)
    name = "images/view_3.png"
    pose = truth.cameras[name].camera_to_world
    turned = pose[:, :3] @ Rotation.from_euler("y", 0.2, degrees=True).as_matrix()
    wrong = replace(truth.cameras[name], camera_to_world=np.column_stack([turned, pose[:, 3]]))
    estimated = elsewhere(replace(truth, cameras={**truth.cameras, name: wrong}))
    alignment = align_poses(estimated, truth)
    worst = int(np.argmax(alignment.errors_px))
    assert alignment.names[worst] == name
    shift = 500 * np.tan(np.radians(0.2))
    np.testing.assert_allclose(alignment.errors_px[worst], shift, rtol=0.1)
    np.testing.assert_allclose(alignment.rotation_errors_deg[worst], 0.2, rtol=0.1)
