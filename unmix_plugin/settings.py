"""All that a user can set of the method and of its data; what follows from the scene is found by `resolve_auto`.

Nothing here imports what it sets up, so that the help of commands is quick. Settings that only tests and the method as
published need are annotated with `Unlisted`: they work as flags, but no help lists them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from unmix_plugin.engine.configs import (
    AtStartOnly,
    Check,
    CommonFlag,
    DataManagerConfig,
    ModelConfig,
    Settings,
    Target,
    UnlistedFlag,
    Within,
    short_flag,
)
from unmix_plugin.errors import ConfigError
from unmix_plugin.presets import Auto, fill_auto, preset_for

if TYPE_CHECKING:
    import numpy as np
    import torch

Light = Literal["fixed", "camera", "per-view"]
EndmemberInit = Literal["kmeans", "vca", "nfindr", "minimum-volume", "pairs", "pooled", "file"]
T = TypeVar("T")
Unlisted = Annotated[T, UnlistedFlag]

LARGEST_RESOLUTION = 4096
"""Cells along an edge of a hash grid."""
_ROWS_PER_CELL_OF_A_FACE = 1 / 3
_FEWEST_LOG2_ROWS, _MOST_LOG2_ROWS = 16, 19
COARSEST_REFINED = 4
"""Cells along the scene box on the coarsest level at most where poses are refined: a pose that is off by a cell still
finds its way."""
_LARGE_BOX = 300
"""Pixels along the scene box from which on fewer samples per pixel do."""
_USUAL_ENDMEMBERS = 6
_PIXELS_TO_COUNT_BY = 20_000
_WHY_LIGHT = {
    "camera": "the light moves with the camera: brightness depends on the direction of view",
    "per-view": "views differ in exposure: training finds a gain for each (--light fixed leaves them out)",
}
_IS_DARK = "the scene is dark: training compares spectra multiplied by {:.3g} (exposure)"
_IS_UNEVEN = (
    "part of the scene is much brighter than the rest: squared errors are divided by the brightness to the power of "
    "{:.2g} (relative)"
)
_WHY_LOSSES = (("exposure", 1.0, _IS_DARK), ("relative", 0.0, _IS_UNEVEN))
"""Settings of losses that follow from the scene, what they usually are, and why they would be more."""
_LAMP_NUMBERS = 10
"""Which of the two frames, and three places of three numbers."""
_WHERE_LAMP = {
    True: "the place of its lamp follows from shadows: training models them, and refines the place",
    False: "no shadows tell the place of its lamp: shadows that move are blurred",
}


@dataclass(frozen=True)
class SceneOptions(Settings):
    """How to read a scene."""

    _called = "the scene"
    value_scale: Annotated[
        float | None, CommonFlag, AtStartOnly, short_flag("value-scale"), Within("[1e-30, 1e30]")
    ] = None
    """Cubes are divided by this number (needed for integer cubes, such as 255 or 4095); None takes them as they are."""
    invalid_pixels: Annotated[Literal["refuse", "mask", "clip"], CommonFlag, short_flag("invalid-pixels")] = (
        "refuse"
    )
    """What to do with pixels that hold NaN, infinite or negative values: refuse the scene; leave them out (mask); or
    set negative values to 0, as suits noise around black, and leave the others out (clip)."""
    allow_outside_paths: Annotated[bool, short_flag("allow-outside-paths")] = False
    """Follow paths in transforms.json that lead out of the scene folder (`..`, absolute, symbolic links)."""
    eval_split: Annotated[Literal["auto", "lists", "filename", "interval"], short_flag("eval-split")] = "auto"
    """Evaluation frames by the lists of transforms.json, by folder or file name, or every n-th; auto takes the first
    of these that the scene supports."""
    eval_interval: Annotated[int, short_flag("eval-interval"), Within("[2, inf)")] = 8
    """With an interval split every n-th frame from the first on, or of a rig every n-th shot, is for evaluation."""
    world: Annotated[Literal["bounded", "unbounded", "auto"], CommonFlag, short_flag("world")] = "auto"
    """Whether all that pictures show lies in a box, or goes on behind it as far as the sky. Auto is bounded where
    pictures have alpha; otherwise it is unbounded if views agree on places outside of the box."""


@dataclass(frozen=True)
class HyperspectralDataManagerConfig(DataManagerConfig):
    """How a scene of spectral images is read and sampled."""

    _target: Target = "unmix_plugin.datamanager:HyperspectralDataManager"
    train_num_rays_per_batch: Unlisted[int] = 2048
    """Rays of the first training step; the model adapts the number to its budget of samples."""
    scene: SceneOptions = SceneOptions()
    """How the files are read and split."""
    subpixels: Annotated[int | Auto, Within("[1, 8]")] = "auto"
    """Rays cast through a pixel, along each of its edges; their mean is the pixel, in training and in rendering. Auto
    is 2, but 1 where the training views have more than 4 million pixels: more pixels teach more than exact ones."""
    single_ray_until: Annotated[Unlisted[float | Auto], Within("[0, 1]")] = "auto"
    """Part of the training in which a pixel has a single ray: coarse shape needs many pixels, not exact ones. Auto is
    0.4 with alpha or before a backdrop, otherwise 0.8."""
    grid_resolution: Annotated[Unlisted[int], Within("[8, 512]")] = 128
    """Cells along an edge of the occupancy grid, from which space is carved that the views show to be empty."""
    trust_alpha: bool = False
    """Believe alpha even where the light of a pixel contradicts it."""
    mend_values: bool = True
    """Replace stripes and spikes in training views by what is around them: values that stand out from the bands
    beside them and from the pixels around them in that. From 8 bands on, for pixels that memory holds."""
    memory_gb: Annotated[float | Auto, Within("[0.01, inf)")] = "auto"
    """GiB of memory for training pixels and for reading them. Auto is most of what the device has left.
    Pixels that need more stay in the scene's files, and a part of them is held that is renewed while training goes
    on."""

    target_components: Annotated[int | Literal["auto", "none"], Within("[1, inf)")] = "auto"
    """Numbers to keep of each training pixel instead of one a band: its components in the subspace that the scene's
    spectra lie in. Auto is none where all bands fit into the memory for training pixels; otherwise, from 100 bands on,
    as many as leave out no more than noise. What training compares are spectra on all bands in any case."""


@dataclass(frozen=True)
class UnmixFieldConfig(Settings):
    """Sizes of the field's grid and networks."""

    _called = "the field"
    num_levels: Annotated[Unlisted[int], Within("[1, 32]")] = 8
    """Levels of the hash grid."""
    features_per_level: Annotated[Unlisted[int], Within("[1, 8]")] = 4
    """Features that the hash grid holds at each vertex of a level."""
    coarsest_resolution: Annotated[Unlisted[int], Within("[2, 4096]")] = 16
    """Cells along an edge of the scene box on the coarsest level."""
    finest_resolution: Annotated[Unlisted[int | Auto], Within("[2, 4096]")] = "auto"
    """The same on the finest level. Auto follows from `cells_per_pixel`."""
    cells_per_pixel: Annotated[float, AtStartOnly, Within("[0.001, 100]")] = 1.7
    """Cells of the finest level along the edge of a pixel where it meets the middle of the scene box: finer ones would
    fit what the views don't show."""
    log2_rows_per_level: Annotated[Unlisted[int | Auto], Within("[4, 24]")] = "auto"
    """Largest number of vertices that a level stores, as a power of two; finer levels share rows by a hash. auto: from
    16 to 19, about a third of the finest level's cells in a face of the scene box."""
    hidden_width: Annotated[Unlisted[int], Within("[1, 1024]")] = 64
    """Width of the hidden layers."""
    temperature: Annotated[float, Within("[0.01, 100]")] = 1.0
    """T of the abundances' softmax: lower is purer."""
    scale: Literal["shared", "per-endmember"] = "shared"
    """One brightness a point, or one a point and endmember, as published."""


@dataclass(frozen=True)
class RendererConfig(Settings):
    """How finely rays are sampled and what is left out."""

    _called = "the renderer"
    samples_per_pixel: Annotated[float | Auto, AtStartOnly, Within("[0.01, 100]")] = "auto"
    """Samples of a ray along the length of a pixel's edge where it meets the middle of the scene box. Auto is 1.5, but
    1 where neither alpha nor a backdrop is known, or the box is more than 300 pixels long: more rays teach more."""
    coarse_samples: Annotated[Unlisted[int | Auto], AtStartOnly, Within("[1, inf)")] = "auto"
    """Samples along the longest edge of the scene box at the start of training, if there are more in the end: what is
    coarse must be found first, by many rays of few samples. Auto is 256, but 64 in an unbounded world, where rays go
    on outside the box."""
    smallest_weight: Annotated[Unlisted[float | Auto], Within("[0, 1)")] = "auto"
    """Samples that contribute less than this share of their ray's light are left out. Auto is 0.004."""
    first_smallest_weight: Annotated[Unlisted[float | Auto], Within("[0, 1)")] = "auto"
    """The same at the start of training. Auto is 0.001 where `smallest_weight` is auto and neither alpha nor a backdrop
    is known, else `smallest_weight`."""
    visible_weight: Annotated[Unlisted[float | Auto], Within("(0, 1]")] = "auto"
    """Share of its ray's light from which a sample counts as seen. Cells that no two training views have lately seen
    are left out; 1 leaves none out. Auto is 0.05 with alpha or before a backdrop, else 1."""


@dataclass(frozen=True)
class LossConfig(Settings):
    """What rendered pixels are compared with, and how much each comparison counts."""

    _called = "the loss"
    background: Literal["random", "black", "white", "last"] | Auto = "auto"
    """What lies behind the scene in training: a random grey a ray, black, white, or the colour of the last sample. Auto
    is random where alpha is known, otherwise black."""
    spectral: Annotated[Unlisted[float], Within("[0, inf)")] = 1.0
    """Weight of the mean squared error of spectra."""
    rgb: Annotated[float | Auto, Within("[0, inf)")] = "auto"
    """Weight of the mean squared error of their sRGB colours, in which dark pixels count more. Auto is 0.2 with
    alpha or before a backdrop, otherwise 0: where black may be the void, it costs quality."""
    band_weights: tuple[float, ...] | Auto = "auto"
    """Weight of the squared error in each band of the scene; none are equal weights. Auto gives less to bands that are
    much noisier than the others, or dead: the reciprocal of their noise's variance. The mean is 1."""
    abundances: Annotated[float, Within("[0, inf)")] = 0.1
    """Weight of the mean squared distance of composited abundances to those of the measured spectra, unmixed one by
    one with the first endmembers; 0 as published. It falls to a tenth of that at the end of training."""
    exposure: Annotated[Unlisted[float | Auto], AtStartOnly, Within("(0, inf)")] = "auto"
    """Factor on spectra, rendered and measured, before they are compared: errors of dark scenes count as much as those
    of bright ones. Auto makes the median opaque pixel as bright as 0.2, but darkens nothing."""
    relative: Annotated[Unlisted[float | Auto], Within("[0, 2]")] = "auto"
    """Power of a pixel's brightness by which squared errors of its spectrum are divided: 0 for absolute errors, 2 for
    relative ones. Auto is 0 unless alpha is known and the brighter pixels are much brighter than the others."""

    def rules(self) -> Iterator[Check]:
        """Weights of bands that count."""
        are_weights = self.band_weights == "auto" or all(weight > 0 for weight in self.band_weights)
        yield Check("band_weights", "above 0, auto or none", are_weights)


@dataclass(frozen=True)
class PoseConfig:
    """How poses are refined."""

    lens: Literal["fixed", "focal", "radial"] = "fixed"
    """What of the lens that all views share is refined too: nothing, its focal length, or also k1 and k2."""
    coarse_until: Unlisted[float] = 0.3
    """Part of the training in which the levels of the field's grid join, the coarsest first: what is fine draws poses
    to the nearest likeness. Where pictures have alpha, space is carved at its end."""
    coarse_steps: Unlisted[int] = 900
    """Steps in which they join at most: what is coarse hardly holds poses, and they drift."""
    start: Unlisted[float] = 0.1
    """Part of the coarse part before which poses stay: the field must show something first."""


@dataclass(frozen=True)
class UnmixModelConfig(ModelConfig):
    """Settings of the model of UnMix-NeRF."""

    _target: Target = "unmix_plugin.model:UnmixModel"
    num_endmembers: Annotated[int | Auto | None, CommonFlag, short_flag("endmembers"), Within("[1, 255]")] = (
        None
    )
    """K, the number of materials to unmix into; auto proposes it from the training pixels. None is 6, or the number of
    bands if that is smaller."""
    endmember_init: Annotated[EndmemberInit, CommonFlag, AtStartOnly, short_flag("endmember-init")] = "pairs"
    """First guess of the endmembers from the pixels of all training views, or spectra from `endmember_file`."""
    endmember_file: Annotated[Path | None, CommonFlag, AtStartOnly, short_flag("endmember-file")] = None
    """CSV of reflectances (wavelength,name,...) for `endmember_init` file; multiplied by the scene's light if known,
    and by one factor for the scene's brightness."""
    specular: Literal["none", "dictionary", "full"] = "dictionary"
    """View-dependent part: none, multiples of a few spectra, or one value a band as published."""
    num_specular_spectra: Annotated[Unlisted[int | Auto], Within("[1, 256]")] = "auto"
    """Spectra of the specular dictionary. The first is the light's, a highlight's colour on anything but metal; then
    come the endmembers', as light that they send on has. Auto is 1 with alpha or before a
    backdrop, else all."""
    train_endmembers: bool = True
    """Whether endmembers change while training; else they stay the first guess, or the spectra from a file."""
    light: Annotated[Light | Auto, CommonFlag, short_flag("light")] = "auto"
    """Light that is fixed, that moves with the camera (objects turned before camera and lamp), or that differs from
    view to view (also exposure). Auto finds which it is; without alpha only whether
    exposures differ."""
    lamp: Annotated[tuple[float, ...] | Auto, AtStartOnly] = "auto"
    """Where the lamp stands that moves with the camera, when training starts: 0 if it turns with the turntable or 1 if
    it also goes up and down with the camera, the turntable's middle and axis, and the way from the middle to the lamp
    (right, up, towards the camera), in model space; numbers need light `camera`. Auto finds it where light is `auto`
    too; no numbers: not known, so shading is a smooth function of direction and shadows that move are blurred."""
    poses: Annotated[Literal["fixed", "refine"], CommonFlag, short_flag("poses")] = "fixed"
    """Whether training takes the poses as they are, or corrects them with the field."""
    pose_refinement: PoseConfig = PoseConfig()
    """How poses are corrected."""
    segmentation: Literal["abundances", "probe"] = "abundances"
    """Material of a ray: its largest abundance, or the endmember of smallest angle to its spectrum as published."""
    samples_per_step: Annotated[int | Auto, Within("[1, 100000000]")] = "auto"
    """Samples of rays that a training step looks at; the number of rays adapts to it. Auto is 25,000 on a CPU and
    400,000 on a GPU, which takes no longer for them."""
    initial_opacity: Annotated[Unlisted[float | Auto], AtStartOnly, Within("(0, 1)")] = "auto"
    """Opacity of one sample's interval in the untrained field. Auto is 0.05 with alpha or before a backdrop, else
    0.01: space between cameras and walls must stay clear."""
    as_published: Unlisted[bool] = False
    """Whether the field is that of the method's authors, and losses compare spectra alone."""
    field: UnmixFieldConfig = UnmixFieldConfig()
    """Sizes of the field."""
    renderer: RendererConfig = RendererConfig()
    """How rays are sampled."""
    losses: LossConfig = LossConfig()
    """What training asks for, and how strongly."""

    def rules(self) -> Iterator[Check]:
        """What belongs together: a lamp and light that moves, endmembers and their file, and what is as published."""
        ours = not self.as_published
        has_lamp, has_file = self.lamp not in ("auto", ()), self.endmember_file is not None
        is_lamp = len(self.lamp) == _LAMP_NUMBERS and self.lamp[0] in (0, 1)
        is_lamp = is_lamp and all(any(self.lamp[first : first + 3]) for first in (4, 7))
        yield Check(
            ("lamp",),
            "a lamp of no or ten numbers, the first 0 or 1, axis and way not 0, or auto",
            not has_lamp or is_lamp,
        )
        yield Check(
            ("light", "lamp"),
            "light camera where numbers of a lamp are given",
            not has_lamp or self.light == "camera",
        )
        yield Check(
            "light",
            "fixed or per-view: the field as published has no shading",
            ours or self.light != "camera",
        )
        yield Check(
            (),
            "a scale per-endmember: the method as published has no shared one",
            ours or self.field.scale == "per-endmember",
        )
        yield Check(
            ("endmember_init", "endmember_file"),
            "endmember-file exactly when endmember-init is file",
            (self.endmember_init == "file") == has_file,
        )

    def resolve_auto(
        self, initial_data: Callable[[], Mapping[str, np.ndarray]], generator: torch.Generator
    ) -> tuple[UnmixModelConfig, str]:
        """With a number of endmembers, the scene's exposure and its light, and the evidence for them.

        Raises:
            SpectrumError: no pixel is neither dark nor saturated.
        """
        import numpy as np
        import torch

        from unmix_plugin.spectral.unmixing.endmembers import drop_uninformative_pixels
        from unmix_plugin.spectral.unmixing.num_materials import propose_num_materials

        found, reasons = self, []
        if self.num_endmembers is None:
            first = initial_data()
            num_bands = len(first["typical"]) if "typical" in first else first["pixels"].shape[1]
            found = replace(found, num_endmembers=_usual_num_endmembers(num_bands))
            if num_bands < _USUAL_ENDMEMBERS:
                reasons.append(
                    f"num-endmembers is {num_bands}: {num_bands} bands can't tell more materials apart"
                )
        if self.num_endmembers == "auto":
            pixels = drop_uninformative_pixels(torch.from_numpy(initial_data()["pixels"]))
            kept = torch.randperm(len(pixels), generator=generator)[:_PIXELS_TO_COUNT_BY]
            count = propose_num_materials(pixels[kept], generator)
            found = replace(found, num_endmembers=count.number)
            reasons.append(count.evidence())
        losses, of_losses = _resolved_losses(self.losses, initial_data)
        found = replace(found, losses=losses)
        reasons += of_losses
        if self.light == "auto":
            light: Light = initial_data().get("light", np.array("fixed")).item()
            found = replace(found, light=light)
            if light != "fixed":
                reasons.append(_WHY_LIGHT[light])
        if self.lamp == "auto" and found.light == "camera":
            numbers = initial_data().get("lamp", np.zeros(0))
            found = replace(found, lamp=tuple(round(float(x), 6) for x in numbers))
            reasons.append(_WHERE_LAMP[bool(found.lamp)])
        return found, "\n".join(reasons)

    def settled(self, longest_edge: float, metadata: Mapping[str, Any]) -> UnmixModelConfig:
        """With values for all that is left at `auto` after `resolve_auto` and follows from what a run keeps of its
        scene: they stand in its config, so that no later release draws it otherwise. How many samples a step looks at,
        and how many rays are rendered at once, depend on the machine.

        Args:
            longest_edge: Of the scene box, in the unit of the metadata's `pixel_size`.
        Raises:
            ConfigError: more endmembers than bands.
        """
        is_unbounded, pixel_size = bool(metadata.get("is_unbounded")), float(metadata["pixel_size"])
        preset = preset_for(metadata["has_alpha"], is_unbounded, bool(metadata.get("has_backdrop")))

        num_bands = len(metadata["wavelengths_nm"])
        count = _usual_num_endmembers(num_bands) if self.num_endmembers is None else self.num_endmembers
        if count == "auto":
            raise ConfigError("num-endmembers is auto: call resolve_auto first")
        if count > num_bands:
            raise ConfigError(
                f"num-endmembers is {count} but the scene has {num_bands} bands; choose at most {num_bands}"
            )
        of_endmembers = count if preset.specular_endmembers else 0

        field, renderer = self.field, self.renderer
        coarsest = field.coarsest_resolution
        if self.poses == "refine":
            coarsest = min(coarsest, COARSEST_REFINED)
        finest = min(math.ceil(field.cells_per_pixel * longest_edge / pixel_size), LARGEST_RESOLUTION)
        finest = max(coarsest, finest if field.finest_resolution == "auto" else field.finest_resolution)
        # A surface passes through as many cells as it has area, so the rows that large scenes need grow with the square
        # of their resolution; small ones would only learn more slowly with more rows.
        cells = 2 * finest if is_unbounded else finest
        rows = round(math.log2(cells**2 * _ROWS_PER_CELL_OF_A_FACE))
        rows = max(_FEWEST_LOG2_ROWS, min(rows, _MOST_LOG2_ROWS))

        is_coarse = not preset.is_carved or longest_edge > _LARGE_BOX * pixel_size
        smallest = (
            preset.first_smallest_weight if renderer.smallest_weight == "auto" else renderer.smallest_weight
        )
        return fill_auto(
            replace(
                self,
                num_endmembers=count,
                field=fill_auto(replace(field, finest_resolution=finest), log2_rows_per_level=rows),
                renderer=fill_auto(
                    renderer,
                    samples_per_pixel=1.0 if is_coarse else 1.5,
                    coarse_samples=preset.coarse_samples,
                    smallest_weight=preset.smallest_weight,
                    first_smallest_weight=smallest,
                    visible_weight=preset.visible_weight,
                ),
                losses=fill_auto(
                    self.losses,
                    background=preset.background,
                    rgb=preset.rgb_loss_weight,
                    exposure=1.0,
                    relative=0.0,
                    band_weights=(),
                ),
            ),
            num_specular_spectra=1 + of_endmembers if self.specular == "dictionary" else 1,
            light="fixed",
            lamp=(),
            initial_opacity=preset.initial_opacity,
        )


def _resolved_losses(
    losses: LossConfig, initial_data: Callable[[], Mapping[str, np.ndarray]]
) -> tuple[LossConfig, list[str]]:
    """With what follows from the brightness and the noise of the scene, and the evidence for it."""
    reasons = []
    for name, usual, why in _WHY_LOSSES:
        if getattr(losses, name) == "auto":
            found = round(float(initial_data().get(name, usual)), 3)
            losses = replace(losses, **{name: found})
            if found > usual:
                reasons.append(why.format(found))
    if losses.band_weights == "auto":
        weights = tuple(round(float(weight), 6) for weight in initial_data().get("band_weights", ()))
        losses = replace(losses, band_weights=weights if any(weight != 1 for weight in weights) else ())
    return losses, reasons


def _usual_num_endmembers(num_bands: int) -> int:
    """Endmembers of a scene whose user gives no number."""
    return min(_USUAL_ENDMEMBERS, num_bands)
