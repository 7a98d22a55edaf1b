"""Keys of a transforms.json that change geometry or values and that we do not follow: refused by name, or said.

Sources: instant-ngp (src/nerf_loader.cu: read_lens, read_focal_length, load_nerf), NeuS2 (the same file), nerfstudio
(data/dataparsers: nerfstudio_dataparser.py, instant_ngp_dataparser.py, dnerf_dataparser.py; cameras/camera_utils.py),
3dgs-deblur (train.py) and Metashape's lens terms (b1, b2) as exporters of its cameras write them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

FILE_NAME = "transforms.json"
_UNDISTORT = "undistort the pictures and write the poses with a pinhole or OPENCV lens"
_ONLY_IN_CAPTURES = {
    **dict.fromkeys(
        (f"ftheta_p{power}" for power in range(6)),
        f"an ftheta lens (instant-ngp); {_UNDISTORT}: unmix-process does both",
    ),
    "from_na": "camera axes of OpenCV (NeuS2), +y down and +z forwards; change the signs of the second and third "
    "column of every transform_matrix and take the key out: unmix-process does both",
}
"""What unmix-process follows: it resamples pictures and turns cameras; scenes may not have it."""
_REFUSED = {
    "latlong": f"pictures of all directions (instant-ngp); {_UNDISTORT}",
    "equirectangular": f"pictures of all directions (instant-ngp); {_UNDISTORT}",
    "orthographic": f"parallel rays (instant-ngp); {_UNDISTORT}",
    "fisheye624_params": f"a lens of Project Aria (nerfstudio); {_UNDISTORT}",
    **dict.fromkeys(("k5", "k6"), f"radial terms of higher powers than k4; {_UNDISTORT}"),
    **dict.fromkeys(("s1", "s2", "s3", "s4"), f"thin prism terms of OpenCV; {_UNDISTORT}"),
    **dict.fromkeys(("b1", "b2", "skew"), f"pixels that are skewed or not square (Metashape); {_UNDISTORT}"),
    **dict.fromkeys(
        ("from_mitsuba", "normal_mts_args"),
        "camera axes of Mitsuba (instant-ngp), +x left and +z forwards; change the signs of the first and third column "
        "of every transform_matrix and take the key out",
    ),
}
"""What a key stands for and what to do, by key. Zero, false and null are as if it was not there."""
_SAID = {
    "rolling_shutter": "rows that were read one after the other (instant-ngp): each picture gets one pose",
    "rolling_shutter_time": "rows that were read one after the other (3dgs-deblur): each picture gets one pose",
    "transform_matrix_end": "a camera that moved during the exposure (instant-ngp): each picture gets one pose",
    "camera_linear_velocity": "a camera that moved during the exposure (3dgs-deblur): each picture gets one pose",
    "fisheye_crop_radius": "pixels that nerfstudio leaves out around a circle: give masks",
    "white_transparent": "white pixels that instant-ngp takes for background: --mask white leaves them out",
    "black_transparent": "black pixels that instant-ngp takes for background: --mask black leaves them out",
    "fix_premult": "colours that instant-ngp divides by their opacity: they are taken as they are",
}
_LENS_KEYS = "fl_x fl_y cx cy w h k1 k2 k3 k4 p1 p2 distortion_params camera_model".split()  # noqa: SIM905
"""Lens keys of frames, which nerfstudio does not look at where the scene has them."""
_OF_SCENES = frozenset(
    """
    datadir applied_transform applied_scale offset ply_file_path wavelengths fwhm value_scale metres_per_unit
    train_filenames val_filenames test_filenames materials illuminant_path endmembers_path mesh_path environment_path
    environment_rotation_deg environment_exposure_stops tone_mapping left_out calibrated_value_of_1
    reflectance_of_1
    """.split()  # noqa: SIM905
)
"""What readers follow beside `frames`, and nowhere else."""
_OF_FRAMES = frozenset(
    """
    transform_matrix row_poses key_poses sensor bands capture file_path hyperspectral_file_path seg_file_path mask_path
    abundance_file_path responses_path
    """.split()  # noqa: SIM905
)
"""What readers follow in a frame, and nowhere else."""
_OF_ALL_CUBES = ("value_scale", "wavelengths", "fwhm")
"""Of these, what makes values wrong where a frame has others than the scene."""
_OF_EITHER = frozenset(
    """
    fl_x fl_y cx cy w h k1 k2 k3 k4 p1 p2 distortion_params camera_model camera_angle_x camera_angle_y x_fov y_fov
    is_fisheye intrinsic_matrix name frames dino_file_path
    aabb aabb_scale scale render_aabb up n_extra_learnable_dims importance_sampling integer_depth_scale
    enable_depth_loading enable_ray_loading sharpen sharpness_discard_threshold sharpness depth_path depth_file_path
    depth_unit_scale_factor driver_parameters envmap orientation_override colmap_im_id rotation time
    transform_matrix_start
    """.split()  # noqa: SIM905
)
"""What readers follow in both; and hints for rendering and training, from `aabb` on, which move no pose."""


def refused_keys(content: Mapping[str, Any], frame: Mapping[str, Any], is_scene: bool = False) -> list[str]:
    """Faults of a frame: keys that are set and stand for what can't be represented.

    Args:
        is_scene: Whether rays are cast through the lens and from the pose as they are; captures bring both into ours.

    >>> refused_keys({"latlong": False, "k6": 0.01}, {})[0][:53]
    "'k6' is set, which stands for radial terms of higher "
    """
    refused = [
        f"'{key}' is set, which stands for {meaning}"
        for key, meaning in (_REFUSED | (_ONLY_IN_CAPTURES if is_scene else {})).items()
        if _is_set(frame.get(key, content.get(key)))
    ]
    return refused + [
        f"has a '{key}' of its own; all cubes of a scene share one: give it beside 'frames', and change the cubes to it"
        for key in _OF_ALL_CUBES
        if frame.get(key) not in (None, content.get(key))
    ]


def keys_to_say(
    content: Mapping[str, Any], frames: Iterable[Mapping[str, Any]]
) -> tuple[list[str], list[str]]:
    """Warnings of keys that change something and are not followed; notes of keys that we have no word for."""
    every = [content, *frames]
    warnings = [
        f"'{key}' is set and not followed: it stands for {meaning}"
        for key, meaning in _SAID.items()
        if any(_is_set(own.get(key)) for own in every)
    ]
    twice = [key for key in _LENS_KEYS if any(_differs(content.get(key), own.get(key)) for own in every[1:])]
    if twice and not any("sensor" in own for own in every[1:]):  # which nerfstudio has no word for
        warnings.append(
            f"{', '.join(twice)}: frames have other values than the scene; the frames' are used, nerfstudio takes the "
            "scene's. Take out those that are wrong"
        )
    if len({repr(own["time"]) for own in every[1:] if "time" in own}) > 1:
        warnings.append("frames have a 'time': what moves between views is taken to stand still")
    if misplaced := [key for key in content if key in _OF_FRAMES and _is_set(content[key])]:
        warnings.append(
            f"{', '.join(misplaced)}: not followed beside 'frames'; give it in each frame that it is for"
        )
    in_frames = [
        key
        for key in sorted(_OF_SCENES.difference(_OF_ALL_CUBES))
        if any(own.get(key) not in (None, content.get(key)) for own in every[1:])
    ]
    if in_frames:
        warnings.append(
            f"{', '.join(in_frames)}: not followed in frames; give it beside 'frames', for all of them"
        )
    known = _OF_SCENES | _OF_FRAMES | _OF_EITHER | set(_REFUSED) | set(_ONLY_IN_CAPTURES) | set(_SAID)
    unknown = sorted({key for own in every for key in own} - known)
    notes = [f"keys that are not known and not used: {', '.join(unknown[:8])}"] if unknown else []
    return warnings, notes


def _differs(common: Any, own: Any) -> bool:
    """Whether a frame and the scene both give a value, and not the same."""
    return common is not None and own is not None and common != own


def _is_set(value: Any) -> bool:
    """Whether a value is more than zero, false or nothing, also in a list."""
    left = [value]
    while left:
        one = left.pop()
        if isinstance(one, list):
            left += one
        elif one:
            return True
    return False
