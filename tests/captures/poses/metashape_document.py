"""Cameras as Metashape exports them."""

import numpy as np

from tests.captures.poses.pose_factory import FLIP

SENSOR = """<sensor id="0" label="lens" type="{kind}"><resolution width="640" height="480"/>
<property name="pixel_width" value="0.004"/><property name="pixel_height" value="0.005"/>
<property name="focal_length" value="2"/>{calibration}</sensor>"""
CALIBRATION = """<calibration type="{kind}" class="adjusted"><resolution width="640" height="480"/>
<f>500</f><cx>3</cx><cy>-4</cy>{terms}</calibration>"""


def text_of(matrix):
    return " ".join(repr(float(value)) for value in np.asarray(matrix).ravel())


def document(poses, component="", chunk="", terms="", kind="frame", calibration=CALIBRATION, extra=""):
    """What Metashape writes for cameras at these poses of the chunk, all in a group."""
    cameras = "".join(
        f'<camera id="{index}" sensor_id="0" component_id="0" label="{name}"><transform>'
        f"{text_of(np.vstack([np.column_stack([pose[:, :3] @ FLIP, pose[:, 3]]), [0, 0, 0, 1]]))}"
        "</transform></camera>"
        for index, (name, pose) in enumerate(poses.items())
    )
    sensor = SENSOR.format(kind=kind, calibration=calibration.format(kind=kind, terms=terms))
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="c" enabled="true">{chunk}'
        f'<sensors>{sensor}</sensors><components><component id="0">{component}</component></components>'
        f'<cameras><group id="0">{cameras}</group>{extra}</cameras></chunk></document>'
    )
