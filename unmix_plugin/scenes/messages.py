"""All messages about a scene folder: a code for logic and tests, and the template of the sentence for people.

A sentence says what was found against what was expected, and what to do. docs/reference/scene-folder.md lists them all;
`python -m tests.docs.test_scene_messages` writes that list anew.
"""

from __future__ import annotations

from enum import Enum, unique
from typing import Any


@unique
class Message(Enum):
    """Each with its template, what the page adds to it, and how the page shows it, if not by its template."""

    # The folder and its file
    NO_FOLDER = (
        "the scene folder is not there; give the folder that holds transforms.json with --data",
        "if a scene was moved, give its new place",
    )
    FOLDER_IS_FILE = "is a file, not a scene folder; give the folder that holds transforms.json with --data"
    NO_FILE = "is not in the scene folder; unmix-process makes a scene of raw files"
    FILE_UNREADABLE = "cannot be read ({reason})"
    NO_JSON = (
        "{reason}",
        "write the file again: a copy may be incomplete",
        "is empty; expected JSON; is not valid JSON; is not readable as JSON",
    )
    NO_OBJECT = "holds {found}; expected an object with 'frames'"
    NO_LIST = ("'{key}' {found}; expected a list with one object a {what}", "list one object a view")
    NO_FRAMES = "'frames' is empty; a scene needs frames to train on and to evaluate"
    FRAME_NO_OBJECT = "is {found}; expected an object"
    WRONG_VALUE = (
        "'{key}' is {found}; expected {expected}",
        "numbers are finite, sizes whole, focal lengths above 0 in pixels, paths without control characters",
    )

    # Bands
    NO_WAVELENGTHS = "'wavelengths' {found}; expected a list of the bands' centres in nm"
    WAVELENGTH_NO_NUMBER = "'wavelengths' has {found} at band {band}; expected a positive number in nm"
    WAVELENGTHS_FALL = (
        "'wavelengths' must increase; got {before:g} nm then {after:g} nm at band {band}; sort the bands of "
        "wavelengths "
        "and cubes alike"
    )
    WAVELENGTHS_NO_NM = (
        "'wavelengths': {reason}",
        "they look like micrometres (multiply them by 1000), or count the bands (give their wavelengths in nm)",
    )
    WRONG_WIDTHS = (
        "'fwhm' must have a width in nm above 0 for each of the wavelengths (0 or null where it is unknown), or be "
        "left "
        "out"
    )
    UNSEEN_BANDS = (
        "no training frame sees the bands at {bands} nm; leave them out",
        "or train on frames that see them",
    )
    BAND_OUTSIDE = "'bands' has {band}; expected 0 to {last}, indices into 'wavelengths'"
    BANDS_AND_RESPONSES = "has 'bands' and 'responses_path'; a sensor has one of them, drop the other"
    BANDS_REPEAT = "'bands' repeats {bands}; expected each band once"
    WRONG_RESPONSES = ("{reason}", "see CSV above", "a table of responses: what is wrong with it")
    RESPONSES_UNCOVERED = (
        "{path}: {reason}; 'wavelengths' must cover all channels",
        "the bands must reach as far as the responses do, and leave no gap in them",
    )
    SENSOR_OF_OTHER_SIZE = "has {found} pixels, others of sensor {sensor!r} {expected}; name it otherwise"
    SENSOR_OF_OTHER_BANDS = "has other bands than others of sensor {sensor!r}; name it otherwise"

    # Poses
    NO_POSE = "{name} {found}; expected 4 (or 3) rows of 4 finite numbers, camera to world"
    LAST_ROW = "{name} is not rigid: its last row is ({row}); expected (0, 0, 0, 1)"
    NOT_RIGID = (
        (
            "{name} is not rigid: its axes have lengths ({lengths}) and R^T R is off the identity by {deviation:.3g}; "
            "expected a rotation without scale or shear"
        ),
        "take the scale out of the rotation",
    )
    REFLECTION = "{name} is a reflection (determinant -1); expected a rotation, flip one axis"
    FAR_AWAY = "{name} puts the camera at {position}; expected less than 1e9 units away"
    SEVERAL_POSES = "has {keys}; expected one of them"
    NO_LINE_POSES = "'{key}' is {found}; expected a list of at least two poses"
    ROWS_FALL = "the rows of '{key}' must increase; got {before:g} then {after:g}"
    GREAT_TURN = (
        "the camera turns by {turn:.0f} degrees from row {before:g} to row {after:g}; expected at most {most:g}, give "
        "more key poses"
    )
    NO_KEY_POSE = "is {found}; expected an object with 'row' (a number) and 'transform_matrix'"
    NO_ROW = "has the row {found}; expected an object with 'row' (a number) and 'transform_matrix'"
    ROW_POSES_MISFIT = "'row_poses' has {poses} poses, but the image has {rows} rows; expected one pose a row"
    KEY_POSES_END = (
        "'key_poses' reach from row {first:g} to row {last:g}, but the image has rows 0 to {rows}; expected key poses "
        "at "
        "both ends or beyond"
    )
    WRONG_TRANSFORM = (
        "'applied_transform' is {found}; expected 3 rows of 4 numbers, a rotation and a translation; put scale into "
        "'applied_scale', or drop the key"
    )
    WRONG_OFFSET = "'offset' is {found}; expected 3 finite numbers"

    # Lenses
    NO_FOCAL_LENGTH = "'fl_x' is absent; expected the focal length in pixels, of a frame or the scene"
    LENS_MODEL = (
        (
            "camera_model {model} is not supported; expected one of {known}: unmix-process brings such pictures into "
            "an OPENCV lens"
        ),
        "or write `OPENCV` where that is what it is",
    )
    PINHOLE_DISTORTED = "camera_model {model} comes with distortion {terms}; expected OPENCV or zeros"
    FISHEYE_CONTRADICTED = "'is_fisheye' is true and camera_model {model}; drop one of them"
    NO_MATRIX = "'intrinsic_matrix' is {found}; expected 3 rows of 3 numbers in pixels"
    SKEWED_MATRIX = (
        "'intrinsic_matrix' has focal lengths {fx:g}, {fy:g} and skew {skew:g}; expected focal lengths above 0 and no "
        "skew"
    )
    NO_TERMS = "'distortion_params' is {found}; expected the numbers {terms}"
    KEY_REFUSED = (
        "'{key}' is set, which stands for {meaning}",
        "undistort the pictures, or make a scene with `unmix-process`",
    )
    KEY_OF_ONE_CUBE = (
        "has a '{key}' of its own; all cubes of a scene share one: give it beside 'frames', and change the "
        "cubes to it"
    )

    # Paths
    NO_CUBE = "has no 'hyperspectral_file_path'; expected the path of its (H, W, B) .npy cube"
    NO_PICTURE = "has no 'file_path'; expected the path of its picture"
    PATH_UNFOLLOWED = "{path!r} cannot be followed ({reason})"
    PATH_OUTSIDE = (
        "{path!r} leaves the scene folder; {advice}",
        (
            "copy the file in, or use `--allow-outside-paths` if you trust the scene; absolute paths, `..` and "
            "symbolic links out of it count"
        ),
    )
    PATH_MISSING = "{path!r} is missing; add the file or drop the entry"
    PATH_NO_FILE = "{path!r} is not a plain file; add the file or drop the entry"
    CUBE_TWICE = "is a duplicate: its cube {path!r} is that of {other} too; drop one"

    # Cubes
    FILE_CLOSED = "cannot be opened ({reason})"
    NO_NPY = "is not a .npy file; write it with numpy.save"
    NPY_VERSION = "is a .npy file of version {version}; write it with numpy.save"
    NPY_DAMAGED = "has a damaged .npy header; write it again"
    NPY_SHAPE = "has the shape {shape} in its .npy header; write it again"
    NPY_PICKLED = "holds pickled Python objects, which are never loaded: they can run code"
    NPY_TYPE = "holds {dtype} values; expected a float or an integer type"
    NPY_CUT = "is cut short: {found} bytes of values found, {expected} expected for shape {shape}"
    NO_CUBE_SHAPE = "has shape {shape}; expected {expected}"
    CUBE_SIZE = (
        "the cube has {width} x {height} pixels (width x height); expected {wide} x {high}, {reason}",
        "the cubes of a sensor have one size",
    )
    CUBE_BANDS = "the cube has {found} bands; expected {expected}, as {reason}"
    CUBE_INVALID = (
        "{subject} {found} values in {pixels} of {all_pixels} pixels{lowest}; {remedy}",
        (
            "mend the cube, or leave these pixels out with `--invalid-pixels mask`; for negative noise after dark "
            "subtraction use `--invalid-pixels clip`"
        ),
    )
    CUBE_ALL_INVALID = "every pixel of the cube has a NaN, infinite or negative value; drop the frame"
    CUBE_FAR_NEGATIVE = "the cube has {count} values far below 0, which is not noise; check its dark frame"
    CUBE_INTEGER = (
        "the cube holds integers (up to {greatest:g} in this scene); give --value-scale {scale:g}, the number that "
        "stands for 1{meaning}"
    )
    CUBE_FAR_OFF = (
        (
            "the cube's values are far outside [0, 1]{given} (up to {greatest:g} as stored in this scene); give "
            "--value-scale {scale:g}{or_clip}"
        ),
        "with floats, 1 clips highlights instead",
    )

    # Pictures, masks and labels
    NO_PICTURE_FILE = "cannot be read as a picture: {formats} ({reason})"
    PICTURE_MODE = "is a picture of mode {mode}; expected {expected}"
    PICTURE_SIZE = (
        "the picture has {width} x {height} pixels (width x height); expected {wide} x {high} as the cubes "
        "have"
    )
    NO_ALPHA = (
        "has no picture with alpha, while {other} is transparent in places; give alpha to all or to none"
    )
    MASK_BLACK = ("the mask is black everywhere; drop the frame", "or invert the mask")
    MASK_GREYS = (
        "is a mask with {greys} dark greys up to {brightest}; expected 0 and {white} (black and white), or 0 "
        "and 1"
    )
    MASK_LEAVES_NOTHING = "the mask leaves only pixels with NaN, infinite or negative values; drop the frame"
    LABEL_OUTSIDE = (
        "has label {label}; expected 0 to {last} for the materials, or 255",
        "number labels as `materials` does",
    )

    # Truth
    NO_MATERIALS = "'materials' is {found}; expected a list of different names"
    WRONG_LIGHT = ("{reason}", "see CSV above", "a table of the light: what is wrong with it")
    WRONG_ENDMEMBERS = ("{reason}", "see CSV above", "a table of true materials: what is wrong with it")
    OTHER_MATERIALS = "{path} names {found}; expected the 'materials' {expected}"
    ABUNDANCE_SIZE = (
        "has {width} x {height} pixels (width x height); expected {wide} x {high} as the cubes have"
    )
    ABUNDANCE_COUNT = "has {found} abundances per pixel; expected {expected}, one per material"
    ABUNDANCE_RANGE = "has abundances outside [0, 1] or NaN; expected fractions"

    # Splits
    NO_SPLIT_LISTS = "has no train_filenames, val_filenames or test_filenames; --eval-split lists needs them"
    NOT_A_FRAME = (
        "lists {path!r}, which is the file_path of no frame",
        "write paths in the lists as in the frames",
    )
    IN_BOTH_SPLITS = (
        "is listed for training and for evaluation; a frame trained on cannot judge the result",
        "take the frame out of one list",
    )
    NO_SPLIT_NAME = (
        "neither its folder nor its name starts with train, eval, val or test, which --eval-split filename "
        "needs"
    )
    NONE_TO_TRAIN = "no frame is left to train on ({how}); name some in 'train_filenames'"
    NONE_TO_EVALUATE = (
        "no frame is left to evaluate ({how}); name some in 'test_filenames' or use --eval-split interval"
    )
    WORLD_WITH_ALPHA = (
        "is unbounded, but pictures have alpha, and behind what is transparent there is nothing; expected bounded or "
        "auto, or pictures without alpha"
    )

    # Warnings
    CLIPPED = (
        "{cubes}: up to {share:.2g} of the values are above 1 after division by the value scale {scale:g} and count "
        "as 1 "
        "(up to {greatest:g} as stored); if they are no highlights, give --value-scale {proposed:g}"
    )
    DARK_VALUES = (
        "no value of the cubes is above {share:.2g}{given} (up to {greatest:g} as stored): what a scene shows should "
        "reach up to 1; if it was not that dark, give --value-scale {proposed:g}"
    )
    KEY_NOT_FOLLOWED = "'{key}' is set and not followed: it stands for {meaning}"
    LENS_TWICE = (
        "{keys}: frames have other values than the scene; the frames' are used, nerfstudio takes the scene's. Take out "
        "those that are wrong"
    )
    TIME = "frames have a 'time': what moves between views is taken to stand still"
    NOT_BESIDE_FRAMES = "{keys}: not followed beside 'frames'; give it in each frame that it is for"
    NOT_IN_FRAMES = "{keys}: not followed in frames; give it beside 'frames', for all of them"
    UNKNOWN_KEYS = "keys that are not known and not used: {keys}"
    UNKNOWN_WIDTHS = "'fwhm' has 0 or null for {unknown} of {bands} bands: the widths of all count as unknown"
    FAR_OFF_POSE = (
        "left out of training: {views}, {times:.0f} times as far from the middle of the cameras as nearly all others: "
        "its "
        "pose must be wrong"
    )
    NOTHING_TO_SEE = (
        "the training views show nothing but a plain backdrop or sky: there is no shape that could be learnt",
        "look whether the object is in the pictures",
    )

    POSES_OF_OTHER_CONVENTION = (
        "the poses look like {best}: read so, the training views differ by {as_best:.2f} of what unrelated pixels do; "
        "read as {given}, as expected, {as_given}. If so, take each 'transform_matrix' of transforms.json: {remedy}"
    )
    CAMERAS_AT_ONE_PLACE = (
        "all training cameras stand at one place: turned about itself, a camera sees nothing of how far away things "
        "are, so no other place can be rendered from such views. Move it between views; if it was moved, look whether "
        "each 'transform_matrix' is camera to world: read the other way, all cameras around an object stand at one"
    )
    COPIES_POSED_APART = (
        "the very same values under different poses: {views}. At most one pose of each can be true (unless something "
        "symmetric was rendered without noise): give these views their own files, or leave all but one out"
    )
    COPIES = (
        "the very same values under one pose: {views}. A copy adds nothing to training, and evaluated it is no test: "
        "leave all but one out"
    )
    LENS_FOLDS = (
        "the distortion of {views} folds the picture over: no direction leads to {lost:.1%} of its pixels, and their "
        "rays are wrong. Calibrate the lens anew, with points near the corners too, or mask them"
    )
    MASKS_CONTRADICT = (
        "the masks of the training views contradict each other: behind {share:.1%} of what they show, other views see "
        "only background (expected at most {most:.0%}). {advice}"
    )
    """They do where poses are off by more than a few pixels, where masks err, and where a wall of a room that stands
    among the things is taken for what is behind them."""
    PLAIN_BACKDROP = (
        "pictures have no alpha, but share a plain backdrop: it is learnt as what lies behind the scene, and nothing "
        "is sought where they show it (--world bounded or unbounded does without)"
    )
    BACKDROP_IN_DOUBT = (
        "pictures share what looks like a backdrop, {looks}, but views differ in {share:.0%} of its places: it is kept "
        "as part of the scene. Give pictures alpha if it is none"
    )
    BANDS_OF_NO_USE = "{bands} {what}: its errors {why}; leave it out where you can"
    VALUES_REPLACED = (
        "{share:.2g} of all measured values stand out from the bands and pixels around them (stripes, spikes); "
        "training uses what is around them instead (--pipeline.datamanager.no-mend-values keeps them)"
    )
    SENSORS_WITHOUT_SHARED_BAND = (
        "no other sensor shares a band with {sensors}: only their poses hold their spectra together",
        "nothing, if the poses are good",
    )
    SENSORS_APART = (
        "of what sensor {sensor!r} sees, the other sensors see {share:.0%} (expected at least {most:.0%}): nothing "
        "joins their spectra; check the poses and lenses of the rig"
    )

    ALPHA_AND_POSES = (
        "alpha and poses contradict: only {share:.0%} of the pixels that are not transparent have a place behind them "
        "that no other training view looks through; check that 'transform_matrix' is camera to world with OpenGL axes "
        "(+y up, looking along -z), and that each picture has its own pose"
    )

    # While training
    CUBE_CHANGED = (
        "{path}: the cube can't be read any more ({reason}); a scene must stay as it is while it is trained on",
        "put it back and resume",
    )
    NO_VALID_PIXEL = "no valid pixel is left in the training views: masks leave out every one"
    KEPT_AS_COMPONENTS = (
        (
            "training pixels are kept as {kept} numbers instead of {channels} (target-components): what they leave out "
            "is {residual:.2g} of the noise; {whole:.2%} of the pixels, where it would be more or which are saturated, "
            "are kept whole"
        ),
        "nothing, if the first is below 1; otherwise a larger `target-components`",
    )
    KEPT_ON_DISK = (
        (
            "the training pixels stay on disk: {what} are {total:.3g} GiB; {held:.3g} GiB of them are in memory at a "
            "time, and others are read while training goes on (memory-gb)"
        ),
        "nothing, if the disk is fast; otherwise fewer views, binned pixels or bands, cubes of 16 bits",
    )
    COMPONENTS_OF_NO_USE = (
        "target-components {components} has no effect: even as so many numbers each the training pixels need at least "
        "{needed:.3g} GiB, and pixels on disk keep all bands; choose fewer, or more memory (memory-gb)"
    )

    def __init__(self, template: str, advice: str = "", shown: str = "") -> None:
        self.template = template
        self.advice = advice
        self.shown = shown or template

    def sentence(self, **values: Any) -> str:
        """For people.

        >>> Message.BANDS_REPEAT.sentence(bands="3, 4")
        "'bands' repeats 3, 4; expected each band once"
        """
        return self.template.format(**values)
