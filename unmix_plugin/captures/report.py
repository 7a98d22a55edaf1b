"""Remarks on a capture: a code for logic and tests, with its values, and one sentence for people, which is made where
it is printed.

A code's kind tells where the sentence goes: among what looks wrong, what was measured, or what was done. In a template,
`{count:view}` is a number of views in words, a sequence is its first few items (`{names:5}`: five), `{where}` names the
views or files that a remark is about, and `{count}` counts them.
"""

from __future__ import annotations

import string
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum, unique
from typing import TYPE_CHECKING, Any

from unmix_plugin.errors import counted, name_some

if TYPE_CHECKING:
    from unmix_plugin.engine.decisions import Decision

_WIDTH = 110
_MATCHED = (
    "{points} points matched in three views or more are seen {missed} px from where poses and lens put them "
    "({percentile} % of them less)"
)


class Kind(Enum):
    """What a remark is, by the heading that it stands under."""

    WRONG = "What looks wrong"
    MEASURED = "What was measured"
    DONE = "What was done"


def _wrong(template: str) -> tuple[Kind, str]:
    return Kind.WRONG, template


def _done(template: str) -> tuple[Kind, str]:
    return Kind.DONE, template


def _measured(template: str) -> tuple[Kind, str]:
    return Kind.MEASURED, template


def _doubt(template: str) -> tuple[Kind, str]:
    """Of a file: what may make its values, wavelengths or geometry wrong; its sentence begins with names of files."""
    return Kind.WRONG, "{files}" + template


@unique
class Code(Enum):
    """All that may be remarked, with its kind and the template of its sentence."""

    NOTE = _done("{text}")
    """Of a layout or of a library, which has no code of its own for it."""
    CAPTURE_WARNING = _wrong("{text}")
    """Of a layout or a source of poses, which has no code of its own for it."""

    # Files: which numbers are the image, and of which axes.
    HEADER_LINES_UNREAD = _doubt("{lines:line} of the header not read for want of '=': {first}")
    HEADER_OF_OTHER_SIZE = _doubt(
        "{header} describes {found} rows, columns and bands, the image has {size}: not used"
    )
    BYTE_ORDER_ASSUMED = _doubt("the header has no byte order; taken as little-endian")
    BYTES_LEFT = _doubt("{left} bytes more than the header describes")
    DARK_LINES_APART = _done(
        "the lines from '{entry}' on were taken with the shutter closed: they are no part of the image, but the dark "
        "frame of raw numbers that have no other"
    )
    DARK_LINES_SEVERAL = _doubt("'{entry}' has {count_stated} numbers: dark lines may be left in the image")
    DARK_LINES_NO_NUMBER = _doubt("'{entry}' is {value}, no number: dark lines may be left in the image")
    LINE_RATE_NO_NUMBER = _done("'{entry}' is {value}, no number: how fast lines were taken is not known")
    NO_DATA_NO_NUMBER = _doubt("'{entry}' is {value}, no number: not used")
    ENTRY_NO_NUMBER = _doubt("{entry} is {value}, no number: not used")
    ENTRY_UNREADABLE = _doubt("{entry} can't be read: not used")
    AXES_AMBIGUOUS = _doubt(
        "{number} wavelengths fit several axes of {shape}; bands are taken to be axis {axis}"
    )
    AXES_UNLIKELY = _doubt(
        "bands are taken to be axis {axis} of {shape}, though axis {shortest} is the shortest; if that is wrong, say "
        "which axis is which (--axes {other})"
    )
    OPTION_UNUSED = _done("--{option} does nothing: the format {reader} leaves no choice")
    ARRAYS_UNUSED = _done("also in the file, and not used: {names}")
    PAGES_LEFT_OUT = _doubt("pages of other sizes or types are left out: {pages}")
    PARTS_LEFT_OUT = _doubt("only the first part is taken; the file also has the parts {names}")
    PARTS_ALIKE = _doubt(
        "wavelengths of the first part are taken; {number} other parts have the same ones (--dataset)"
    )
    LAYER_TAKEN = _doubt("layer '{layer}' is taken; the file also has {others} (--dataset)")
    BANDS_OF_OTHER_KINDS = _done("{number} {pictures} than {kind} in the folder left out")
    PARTS_JOINED = _done("{parts} parts of one scan were joined: {names:6}")
    MOSAIC_TAKEN_APART = _done(
        "a mosaic of {filters} filters was taken apart: bands of one pixel lie up to {apart} pixels of the file beside "
        "each other"
    )
    MOSAIC_RIM_LEFT_OUT = _done(
        "{rows} rows and {columns} columns at the end, which fill no block, are left out"
    )
    MASK_OF_OTHER_SIZE = _doubt(
        "the mask {mask} has {size} rows, columns and bands, not those of the image: not used"
    )
    MASK_USED = _done("pixels where {mask} is 0 count as not measured")
    WINDOW_IS_PART = _done("the data window is a part of the picture: pixels outside are missing")
    BLOCKS_ABSENT = _doubt(
        "{blocks:block} of the image left out in the file, which has no no-data value: {taken}; if these are dark and "
        "not missing, write the file without gaps (GDAL's SPARSE_OK=FALSE)"
    )
    CHUNKS_ABSENT = _doubt(
        "{chunks:chunk} of the image never written, and no attribute says what marks them: pixels of {fill} {taken}; "
        "if these were measured, write the file in full"
    )
    OPACITY_IS_A_BAND = _doubt("a number of each pixel is marked as opacity; it is kept as a band")
    OPACITY_LEFT_OUT = _done("the picture has opacity, which is not a band and is left out")

    # Files: what numbers mean.
    COLOURS_AS_STORED = _doubt(
        "red, green and blue are taken as light, as stored; if they are a picture's for people (sRGB), save it as PNG "
        "of 8 bits"
    )
    GDAL_DAMAGED = _doubt("GDAL's metadata in the file is damaged: gains and wavelengths in it are not used")
    XML_DAMAGED = _doubt("{xml} is damaged: what it says is not used")
    XML_OF_OTHER_BANDS = _doubt(
        "{xml} describes {described:band}, the image has {bands}: wavelengths and gains in it are not used"
    )
    FACTOR_NOT_APPLIED = _doubt("'{entry}' is {value}: not applied, as ENVI knows no such field")
    GAINS_CHOSEN = _doubt("{applied} is applied, not {other}")
    GAINS_OF_SOME_BANDS = _doubt(
        "{entry} is stated of {stated} of {bands} bands: that of the others is taken for {usual}, and "
        "their values may be off by a factor"
    )
    GAINS_OF_SOME_FILES = _doubt(
        "only some of the files of one view state gains or a scale: numbers of the others are taken as stored"
    )
    EXPOSURE_NOT_UNDERSTOOD = _doubt("{entry} is {value}, which is not understood: exposures may differ")
    GAIN_PARTS_MISFIT = _doubt("{entries} are lists of different lengths: exposures may differ")
    BAND_GAINS_UNKNOWN = _doubt(
        "the gain is known of some bands and not of {lacking}: exposures are not compared; write it into all files, or "
        "none"
    )
    BAND_GAINS_TAKEN_AS_ONE = _doubt(
        "the gain is 1 in some bands and not known of {lacking}, where it is taken for 1, too: values may be off by a "
        "factor"
    )
    BAND_EXPOSURES_UNKNOWN = _doubt(
        "one exposure time and gain is not known of every band: exposures are not compared"
    )
    BAND_F_NUMBERS_UNKNOWN = _doubt(
        "the f-number of the lens is known of some bands and not of {lacking}: exposures are compared without it"
    )

    # Files: bands.
    BAND_LIST_MISFIT = _doubt("{what} are left out: {number} for {bands} bands")
    BAND_LIST_NO_NUMBERS = _doubt("{what} are not a list of numbers ({error}) and are left out")
    BAND_LIST_NOT_FINITE = _doubt("{what} are left out: that of band {band} (from 0) is {value}")
    WAVELENGTHS_COUNT_BANDS = _doubt(
        "{entry}: {low} to {high} with no unit count the bands and are no wavelengths; correct them there, or give "
        "them yourself (--wavelengths of unmix-process)"
    )
    WAVELENGTHS_WITHOUT_UNIT = _doubt(
        "{entry}: {low} to {high} with {unit} can't be brought to nm; correct them there, or give them yourself "
        "(--wavelengths of unmix-process)"
    )
    WAVELENGTHS_IMPOSSIBLE = _doubt(
        "{entry}: {low} to {high} can't be in {unit}; correct them there, or give them yourself (--wavelengths of "
        "unmix-process)"
    )
    WAVELENGTH_REPEATED = _doubt("two bands beside each other have the same wavelength")
    WIDTHS_ALONE = _doubt("FWHM are left out, as the file gives no wavelengths beside them")
    WIDTHS_NOT_POSITIVE = _doubt("FWHM are left out: they go down to {low}")
    WIDTHS_IMPOSSIBLE = _doubt("FWHM are left out: they would be {range}")
    WIDTHS_IN_OTHER_UNIT = _doubt(
        "FWHM: {low} to {high} taken as {unit}, as they can't be in the unit of the wavelengths"
    )

    # Views that are left out.
    VIEW_BLACK = _wrong(
        "{where} is left out: it shows nothing, its brightness is {share} of the usual one; --keep-view {where} "
        "takes it back"
    )
    VIEW_OVEREXPOSED = _wrong(
        "{where} is left out: it is overexposed, {share} of what it shows is saturated and the rest is {times} "
        "times as bright as in the views around it; --keep-view {where} takes it back"
    )
    VIEW_EXPOSED_OTHERWISE = _wrong(
        "{where} is left out: it is {times} times as bright as the views around it, in all bands, from dark to "
        "bright: exposed otherwise than its file says; --keep-view {where} takes it back"
    )
    VIEW_BLURRED = _wrong(
        "{where} is left out: it is blurred, with {share} of the fine contrast of the views around it; --keep-view "
        "{where} takes it back"
    )
    VIEW_OF_OTHER_POSE = _wrong(
        "{where} is left out: with its pose it differs from the views around it {off} as much as with the pose of any "
        "other view, where {usual} are usual: does the pose belong to another view? --keep-view {where} takes it back"
    )
    VIEW_UNREADABLE = _wrong("{where} is left out, as its file can't be read: {why}")
    VIEW_NOT_WANTED = _done("{where} is left out, as --leave-out says")

    # Poses: whose they are, and where the scene lies.
    POSES_MATCHED = _done("{matched} of {views} views were matched {how}")
    NAMES_AS_TEXTS = _done(
        "names were sorted as texts: {first}; if poses go by numbers, give these leading zeros"
    )
    VIEWS_UNPOSED = _done("views without pose: {names}")
    CAMERAS_UNUSED = _done("{cameras:camera} without view: {names}")
    NAMES_SHARED = _done("several views or cameras share the name of {names}; rename them")
    NUMBERS_SHIFTED = _wrong(
        "the numbers in names of cameras are those of the views {apart}: if one was counted from 0 and the other from "
        "1, views have the poses of their neighbours; rename the files of one"
    )
    MANY_VIEWS_UNPOSED = _wrong(
        "{unposed} of {views} views have no pose and are left out ({names}): is {source} the whole model, and are the "
        "names in it those of the files?"
    )
    RIG_WITHOUT_POSE = _done("{views:view} of lens {lens} left out: no lens of their shot has a pose")
    RIG_OFFSET_UNKNOWN = _done(
        "{views:view} of lens {lens} left out: there is no pose, and nothing says where the lens is on the rig"
    )
    RIG_AS_OTHER_SHOTS = _done(
        "{views:view} of lens {lens} got the pose of another lens of their shot, moved as in other shots"
    )
    RIG_AS_FILES_SAY = _done(
        "{views:view} of lens {lens} got the pose of another lens of their shot, turned as the files say, at the "
        "same place"
    )
    LENS_OF_SENSOR = _done("lens {lens}: {text}")
    LENS_SCALED = _done("lenses given for {given} were scaled to {size}")
    LENS_PERHAPS_CUT = _wrong(
        "the lens of view {view} is given for {given}, its file has {size}: taken as scaled. If it was cut instead, "
        "give the lens of the cut picture"
    )
    UP_OF_SOURCE = _done("up is the source's")
    UP_AGAINST_FLIGHT = _done("up is against where the cameras look, as they would in a flight")
    UP_BY_AXES = _done("up is square to the cameras' horizontal axes")
    UP_BY_MEAN = _done("up is the mean of the cameras' up vectors")
    UP_UNKNOWN = _done("up is not to be told from the cameras: +z of the source is taken")
    MIDDLE_OF_POINTS = _done("the middle is that of the sparse points, as the cameras look at no one place")
    MIDDLE_OF_AXES = _done("the middle is the point nearest to all optical axes")
    MIDDLE_OF_CAMERAS = _done("the middle is that of the cameras")
    UNIT_OF_SCENE = _done("1 unit of the scene is {units} of the source")
    SCALE_BY_DISTANCE = _done(
        "the scale is that of two points {metres} m apart, {pixels} px in the view that shows most: 1 px off there is "
        "{share} of all lengths or more"
    )

    # Masks.
    NO_MASK_FOUND = _wrong(
        "no mask: files have no alpha channel and no backdrop was found that all views share, so that all of each "
        "picture is taken for the scene; right for rooms and landscapes (--mask none), otherwise give --mask white, "
        "black or files"
    )

    OPACITY_OF_SOME = _done(
        "{count} of {views} views {has} no alpha channel ({where}), so that of the others is not used: give all "
        "views one, or choose --mask"
    )
    BACKDROP_FOUND = _done(
        "a backdrop was found that all views share, {backdrops}, and is cut out: look at contact-sheet.png; "
        "--mask none keeps it"
    )

    # Pictures.
    PICTURES_ARE_SRGB = _done("pictures are taken as sRGB and brought to linear light")
    COLOURS_IN_ORDER = _done(
        "the channels of pictures are red, green and blue in this order: {red} nm is taken for red, {green} nm for "
        "green, {blue} nm for blue. If this is wrong, give --wavelengths {blue},{green},{red}"
    )
    ORIENTATION_IGNORED = _done(
        "EXIF's orientation of {turned} of {files} pictures is ignored, as poses and lenses refer to the stored "
        "pixels; if yours were made from turned pictures, store these turned"
    )

    # Values.
    ONE_LOST_ABOVE = _wrong(
        "values ({units}) were divided by {scale}, as more than {limit} are above 1{hint}: outputs of reflectance "
        "undo it, and exported radiance times {scale} is what was measured; --scale 1 keeps values, and cuts off those "
        "above 1"
    )
    ONE_LOST_BELOW = _wrong(
        "values ({units}) were divided by {scale}, as nearly all are below {limit}{hint}: outputs of reflectance "
        "undo it, and exported radiance times {scale} is what was measured; --scale 1 keeps values, and cuts off those "
        "above 1"
    )
    GIVEN_SCALE_LOW = _wrong(
        "--scale {scale} is too low: {share} of the sampled values are above it, up to {greatest}, and are written as 1"
    )
    GIVEN_SCALE_HIGH = _wrong(
        "--scale {scale} is too high: of the sampled values none is above {greatest}, and all are written as less than "
        "{limit}; without --scale it is found from the values"
    )
    BELOW_BLACK = _wrong(
        "values lie below 0 by more than noise, and are written as 0: the dark frame is brighter than that of these "
        "views, or was taken off their numbers before"
    )
    NO_DATA_UNNAMED = _wrong(
        "many pixels hold {number} in every band, which no light leaves, and count as measured: if that marks missing "
        "pixels, name it in the files (ENVI: 'data ignore value = {number}'; GeoTIFF: GDAL's no-data value)"
    )
    SATURATED_BELOW_ONE = _wrong(
        "values are saturated from {end} on, and are written as 1, which is read as at least {scale}: expose less, "
        "or make that true with --scale {end}, which cuts off all above"
    )

    # Exposures.
    EXPOSURE_COUNTED_BEFORE = _done(
        "views were exposed {exposed} {unit}: values are not divided by that, as {source} says that they are "
        "reflectance or radiance already"
    )
    EXPOSURES_EVENED = _done(
        "views were exposed {exposed} {unit}: each is brought to that of {whose}, {common}"
    )
    EXPOSURE_UNKNOWN = _wrong("{missing:view} without exposure time: exposures are not compared")
    EXPOSURE_FACTOR_UNKNOWN = _wrong(
        "the {factor} is known of some files and not of {lacking}: exposures are not compared; write it into all, "
        "or none"
    )
    GAIN_TAKEN_AS_ONE = _wrong(
        "the gain is 1 in some files and not known of {lacking}, where it is taken for 1, too: values may be off "
        "by a factor"
    )
    WHITE_EXPOSURE_UNKNOWN = _wrong(
        "views were exposed {exposed} {unit}, the white reference does not say how long: reflectances may be off "
        "by a factor"
    )
    DARK_EXPOSED_OTHERWISE = _wrong(
        "the dark frame was exposed {of_dark} {unit}, what it is subtracted from {of_others}: dark current "
        "grows with exposure, so take a dark frame at each"
    )
    EXPOSURES_OF_PICTURES = _wrong(
        "pictures were exposed {exposed} {unit}, which can't be undone as cameras encode the brightness of pictures:"
        " fix the exposure"
    )
    EXPOSURES_OF_REFLECTANCES = _wrong(
        "views were exposed {exposed} {unit}: values are not divided by that, as they are at most about 1 and "
        "taken for reflectances. If they grow with the exposure, as raw numbers do, give a white reference, or "
        "divide them by it yourself"
    )
    EXPOSURES_MISFIT = _wrong(
        "{where}: {numbers} exposure times or gains for {bands:band}: exposures may differ and were not compared. "
        "Give one number, or one a band, with points as decimal marks"
    )
    EXPOSURE_UNITS_MISSING = _wrong(
        "{factor} have no unit in some files ({sources}): values may be off by a factor"
    )
    EXPOSURE_OF_SOME_SENSORS = _wrong(
        "exposures of {lacking} are not known or not compared, those of {known} are: values of these lenses or "
        "cameras may be off by a factor"
    )
    UNLIKE_MEANINGS = _wrong(
        "values of lenses or cameras are not of one kind ({kinds:5}): they may be off by a factor against each "
        "other"
    )

    # Bands.
    WHITE_SATURATED = _wrong(
        "{file}: the white is saturated in {bands}: these bands are left out; take it again with a shorter "
        "exposure"
    )
    REFERENCE_UNMEASURED = _wrong(
        "{file}: nothing was measured in {bands} (NaN or no-data): these bands are left out"
    )
    NOISY_BANDS_KEPT = _done(
        "{noisy} of {bands} bands have noise above {limit} of their signal; all are kept"
    )

    # The written scene: places of cameras, pictures, exposure, moving light.
    FEW_VIEWS = _wrong("only {views} views: expect holes and fog; {enough} or more all around serve better")
    VIEWS_SATURATED = _wrong("{views:view} with more than {limit} saturated pixels: {named:5}")
    VIEWS_MISSING = _wrong("{views:view} with more than {limit} missing pixels: {named:5}")
    VIEWS_EMPTY = _wrong("{views:view} without any foreground, by the mask: {named:5}")
    SIDES_UNJUDGED = _measured("the cameras look at no one place: sides are not judged")
    SIDES = _measured(
        "cameras span {around} degrees around the middle, at elevations of {lowest} to {highest} degrees"
    )
    NARROW_RING = _wrong(
        "a narrow ring: all cameras are within {height} degrees of elevation, so that what is seen from above or below "
        "is a guess; add a second ring 25 degrees higher"
    )
    GAP_IN_RING = _wrong("no camera looks from {gap} degrees of the circle around the object")
    OVERLAP_UNJUDGED = _measured(
        "overlap is not judged: the cameras look at no one place, and there are no sparse points"
    )
    OVERLAP = _measured(
        "views share {usual} with a neighbour (median; least {least}); the nearest one looks from {angle} degrees away "
        "(median; most {most})"
    )
    VIEWS_ALONE = _wrong(
        "{views:view} with hardly any overlap with another one (at most {share}, from {angle} degrees away), take "
        "views in smaller steps: {named:5}"
    )
    BLUR_UNJUDGED = _measured("blur is not judged")
    DETAIL = _measured(
        "finest structures have {detail} times the contrast of those twice as large (median of views)"
    )
    VIEWS_LESS_SHARP = _wrong("{views:view} less sharp than the others: {named:5}")
    BRIGHTNESS_WITHOUT_POINTS = _measured(
        "exposure is not compared: it takes sparse points, as of estimated poses and COLMAP"
    )
    BRIGHTNESS_OF_FEW_POINTS = _measured(
        "exposure is not compared: too few sparse points are seen in every view"
    )
    BRIGHTNESS = _measured(
        "sparse points vary by {deviation} in brightness from view to view (robust deviation)"
    )
    VIEWS_JUMP = _wrong("{views:view} with a jump of exposure, judged by sparse points: {named:5}")
    LIGHT_UNMEASURED = _measured(
        "whether light moves with the camera is not measured: too few sparse points or near views"
    )
    LIGHT = _measured(
        "the brightness of sparse points has a slope of {slope} +- {error} along the movement of the camera ({pairs} "
        "pairs of views; 0 is fixed light)"
    )
    LIGHT_MOVES = _wrong(
        "light moves with the camera, as when an object is turned before fixed lamps: the brightness of sparse points "
        "has a slope of {slope} +- {error} along the movement of the camera ({pairs} pairs of views; 0 is fixed "
        "light). Shading of a point then changes from view to view"
    )
    MASKS_UNCOMPARED = _measured("masks are not compared: there are too few views, or none has a mask")
    MASKS_COMPARED = _measured("behind {share} of what masks show, masks of other views have only background")

    # The written scene: what contradicts itself in its values.
    FILES_PARTLY_READ = _wrong(
        "{files_read:file} of which only a small part was read: {named}. Other parts may hold the spectra: see "
        "'unmix-process inspect', and choose with --dataset"
    )
    BANDS_WIDE = _wrong(
        "{bands:band} too wide to stand for one wavelength: {named:5}; --drop-bands leaves them out"
    )
    EXPOSURE_STEPS = _wrong(
        "{views:view} brighter or darker than near ones by one factor in all bands, from dark to bright pixels, as "
        "with other exposures ({pairs}): look for exposure times or gains that the files do not tell"
    )
    LEVEL_ADDED = _wrong(
        "a level seems to be added to all values: their spectra vary in {rank} ways that do not lead to black (by "
        "{share} of the mean spectrum, {times} times their spread), as light would: look for a dark frame that was not "
        "taken off, or an offset stored beside the numbers"
    )
    BANDS_ODD = _wrong(
        "{bands:band} off against both neighbours by one factor in all views and materials: {named}: a gain that was "
        "not applied, or a line of the lamp without a white reference; leave such bands out with --drop-bands"
    )
    LINES_NOT_MATCHED = _measured(
        "poses and lens are not compared with matched points: lines of one picture have poses of their own"
    )
    TOO_FEW_MATCHED = _measured(
        "poses and lens are not compared with matched points: too few views share features"
    )
    POINTS_MATCHED = _measured(_MATCHED)
    LENS_MISFITS = _wrong(
        f"the pictures do not fit their lens: {_MATCHED}, but {{left}} px with a focal length of {{focal}} and radial "
        "terms that move the corners by {moved} px: is the lens of another model (a fisheye), or given for pictures of "
        "another size or crop?"
    )
    POSES_MISFIT = _wrong(
        f"the pictures do not fit their poses: {_MATCHED}, and no lens brings them below {{left}} px: are the poses "
        "those of these pictures, and in the convention that their file is read with?"
    )
    MASKS_INVERTED = _wrong(
        "{views:view} whose foreground is black while the background has light and texture ({named:5}): are the masks "
        "the wrong way round? White is foreground"
    )
    MASKS_HOLLOW = _wrong(
        "{views:view} whose mask takes the border of the picture for foreground and its middle for background "
        "({named:5}): are the masks the wrong way round? White is foreground"
    )
    MASKS_UNLIKE = _wrong(
        "{views:view} whose mask covers another share of the picture than those of near views: {named:5}; look at "
        "these masks"
    )

    def __init__(self, kind: Kind, template: str) -> None:
        self.kind = kind
        self.template = template

    @property
    def looks_wrong(self) -> bool:
        """Whether values, wavelengths or geometry may be wrong."""
        return self.kind is Kind.WRONG


AXES_IN_DOUBT = (Code.AXES_AMBIGUOUS, Code.AXES_UNLIKELY)


class _Sentences(string.Formatter):
    """Sequences as their first few items, numbers of things in words."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, tuple | list):
            return name_some([str(item) for item in value], int(format_spec or 3))
        if isinstance(value, int) and len(format_spec) > 1 and format_spec.isalpha():
            return counted(value, format_spec)
        return super().format_field(value, format_spec)


@dataclass(frozen=True)
class Remark:
    """One remark: what, with which values, on which views or files."""

    code: Code
    values: Mapping[str, Any] = field(default_factory=dict)
    """By the names in the template of the code; JSON-able."""
    where: tuple[str, ...] = ()
    """Names of the views, lenses or files that it is about; empty where it is about all."""

    @staticmethod
    def of(code: Code, where: Iterable[str] = (), **values: Any) -> Remark:
        """A remark with its values as keywords."""
        return Remark(code, values, tuple(where))

    @property
    def sentence(self) -> str:
        """For people.

        >>> Remark.of(Code.BYTES_LEFT, ["a.hdr", "b.hdr"], left=3).sentence
        'a.hdr, b.hdr: 3 bytes more than the header describes'
        """
        files = f"{name_some(list(self.where))}: " if self.where else ""
        known = {"where": self.where, "count": len(self.where), "files": files, **self.values}
        return _Sentences().vformat(self.code.template, (), known)

    def to_json(self) -> dict[str, Any]:
        """For the record."""
        return {"code": self.code.name.lower(), "where": list(self.where), "values": dict(self.values)}


def merged(remarks: Iterable[Remark]) -> list[Remark]:
    """Each remark once, in their order; of equal ones, one that names all views or files.

    >>> twice = [Remark.of(Code.BYTES_LEFT, [name], left=3) for name in "ab"]
    >>> [remark.where for remark in merged(twice)]
    [('a', 'b')]
    """
    found: dict[tuple[Code, str], Remark] = {}
    for remark in remarks:
        key = remark.code, repr(sorted(remark.values.items()))
        known = found.get(key)
        names = remark.where if known is None else dict.fromkeys((*known.where, *remark.where))
        found[key] = replace(remark, where=tuple(names))
    return list(found.values())


def sentences(remarks: Iterable[Remark], kind: Kind) -> list[str]:
    """The sentences of one kind."""
    return [remark.sentence for remark in merged(remarks) if remark.code.kind is kind]


def report_text(
    title: str,
    wrong: Sequence[str],
    measured: Sequence[str],
    done: Sequence[str],
    decided: Sequence[Decision] = (),
) -> str:
    """One page of text: what looks wrong, what was decided, what was measured, what was done."""
    from unmix_plugin.engine.decisions import decision_table

    wrong, parts = wrong or ["none of the checks found a fault"], [title, ""]
    for heading, lines in zip(Kind, (wrong, measured, done), strict=True):
        parts.append(heading.value)
        parts += [
            textwrap.fill(line, _WIDTH, initial_indent="- ", subsequent_indent="  ", break_long_words=False)
            for line in lines
        ]
        parts.append("")
        if heading is Kind.WRONG and decided:
            indent = " " * (max(len(one.subject) for one in decided) + 11)
            table = decision_table(decided)
            parts += ["What was decided"]
            parts += [
                textwrap.fill(line, _WIDTH, subsequent_indent=indent, break_long_words=False)
                for line in table
            ]
            parts.append("")
    return "\n".join(parts)
