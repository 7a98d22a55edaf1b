"""From what instruments wrote to a scene folder: readers, layouts, calibration, masks, poses, writing.

A layout finds the views of a capture (`Capture`), each a lazy `Cube`; poses come as a `PoseSet`; what is
written is a scene folder as `scenes` reads it.
"""
