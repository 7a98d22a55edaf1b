"""Orientations and calibrations as MicMac writes them."""

ORIENTATION = """<?xml version="1.0" ?><ExportAPERO><OrientationConique>
<FileInterne>Ori-All/AutoCal.xml</FileInterne><TypeProj>eProjStenope</TypeProj>
<Externe><Centre>{center}</Centre><ParamRotation><CodageMatr><L1>{l1}</L1><L2>{l2}</L2><L3>{l3}</L3>
</CodageMatr></ParamRotation></Externe><ConvOri><KnownConv>{convention}</KnownConv></ConvOri>
</OrientationConique></ExportAPERO>"""
CALIBRATION = """<?xml version="1.0" ?><ExportAPERO><CalibrationInternConique>
<KnownConv>eConvApero_DistM2C</KnownConv><PP>320.5 238.5</PP><F>500</F><SzIm>640 480</SzIm>
<CalibDistortion>{distortion}</CalibDistortion></CalibrationInternConique></ExportAPERO>"""
RADIAL = "<CDist>322 241</CDist><CoeffDist>{a}</CoeffDist><CoeffDist>-1e-14</CoeffDist>"


def text_of(row):
    return " ".join(repr(float(value)) for value in row)
