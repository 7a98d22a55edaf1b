"""Settings of the model of UnMix-NeRF, and how those that follow from the scene are found."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch

from unmix_plugin.engine.configs import Common, ModelConfig, Target, short
from unmix_plugin.engine.model import Model
from unmix_plugin.errors import ConfigError, require
from unmix_plugin.field import UnmixFieldConfig
from unmix_plugin.light.lamp import NUM_LAMP_NUMBERS, Lamp
from unmix_plugin.losses.training_losses import LossConfig
from unmix_plugin.poses.settings import PoseConfig
from unmix_plugin.presets import AlphaPreset, Auto
from unmix_plugin.rendering.settings import RendererConfig
from unmix_plugin.spectral.evidence import exposure_of
from unmix_plugin.spectral.materials import SegmentationMethod
from unmix_plugin.spectral.unmixing.endmembers import EndmemberMethod, drop_uninformative_pixels
from unmix_plugin.spectral.unmixing.num_materials import propose_num_materials

Light = Literal["fixed", "camera", "per-view"]

_USUAL_ENDMEMBERS = 6
_PIXELS_TO_COUNT_BY = 20_000
_WHY_LIGHT = {
    "camera": "the light moves with the camera: brightness depends on the direction of view",
    "per-view": "views differ in exposure: training finds a gain for each (--light fixed leaves them out)",
}
_WHERE_LAMP = {
    True: "the place of its lamp follows from shadows: training models them, and refines the place",
    False: "no shadows tell the place of its lamp: shadows that move are blurred",
}


def _model() -> type[Model]:
    from unmix_plugin.model import UnmixModel

    return UnmixModel


@dataclass(frozen=True)
class UnmixModelConfig(ModelConfig):
    """Settings of the model of UnMix-NeRF."""

    _target: Target = field(default_factory=_model)
    num_endmembers: Annotated[int | Auto | None, Common, short("endmembers")] = None
    """K, the number of materials to unmix into; auto proposes it from the training pixels. None is 6, or the number of
    bands if that is smaller."""
    endmember_init: Annotated[EndmemberMethod | Literal["file"], Common, short("endmember-init")] = "pairs"
    """First guess of the endmembers from the pixels of all training views, or spectra from `endmember_file`."""
    endmember_file: Annotated[Path | None, Common, short("endmember-file")] = None
    """CSV of reflectances (wavelength,name,...) for `endmember_init` file; multiplied by the scene's light if known,
    and by one factor for the scene's brightness."""
    specular: Literal["none", "dictionary", "full"] = "dictionary"
    """View-dependent part: none, multiples of a few spectra, or one value a band as published."""
    num_specular_spectra: int | Auto = "auto"
    """Spectra of the specular dictionary. The first is the light's, a highlight's colour on anything but metal; then
    come the endmembers', as light that they send on has. Auto is 1 where alpha is known, else all."""
    train_endmembers: bool = True
    """Whether endmembers change while training; else they stay the first guess, or the spectra from a file."""
    light: Annotated[Light | Auto, Common, short("light")] = "auto"
    """Light that is fixed, that moves with the camera (objects turned before camera and lamp), or that differs from
    view to view (also exposure). Auto finds which it is, and takes fixed without alpha."""
    lamp: tuple[float, ...] | Auto = "auto"
    """Where the lamp stands that moves with the camera, when training starts: 0 if it turns with the turntable or 1 if
    it also goes up and down with the camera, the turntable's middle and axis, and the way from the middle to the lamp
    (right, up, towards the camera), in model space. Auto finds it where light is `auto` too; no numbers: not known, so
    shading is a smooth function of direction and shadows that move are blurred."""
    poses: Annotated[Literal["fixed", "refine"], Common, short("poses")] = "fixed"
    """Whether training takes the poses as they are, or corrects them with the field."""
    pose_refinement: PoseConfig = PoseConfig()
    """How poses are corrected."""
    segmentation: SegmentationMethod = "abundances"
    """Material of a ray: its largest abundance, or the endmember of smallest angle to its spectrum as published."""
    samples_per_step: int = 25_000
    """Samples of rays that a training step looks at; the number of rays adapts to it."""
    initial_opacity: float | Auto = "auto"
    """Opacity of one sample's interval in the untrained field. Auto is 0.05 where alpha is known, else 0.01: space
    between cameras and walls must stay clear."""
    field: UnmixFieldConfig = UnmixFieldConfig()
    """Sizes of the field."""
    renderer: RendererConfig = RendererConfig()
    """How rays are sampled."""
    losses: LossConfig = LossConfig()
    """What training asks for, and how strongly."""

    def __post_init__(self) -> None:
        """Refuse impossible settings.

        Raises:
            ConfigError: a number out of its range or settings that contradict each other.
        """
        super().__post_init__()
        count, opacity = self.num_endmembers, self.initial_opacity
        rules = {
            "num-endmembers of 1 to 255 or auto": count in (None, "auto") or 1 <= int(count) <= 255,
            "num-specular-spectra of 1 to 256 or auto": self.num_specular_spectra == "auto"
            or 1 <= self.num_specular_spectra <= 256,
            "samples-per-step of 1 to 100 million": 1 <= self.samples_per_step <= 100_000_000,
            "eval-num-rays-per-chunk of at least 1": self.eval_num_rays_per_chunk >= 1,
            "initial-opacity in (0, 1) or auto": opacity == "auto" or 0 < opacity < 1,
            "a lamp of no or ten numbers, the first 0 or 1, or auto": self.lamp in ("auto", ())
            or (len(self.lamp) == NUM_LAMP_NUMBERS and self.lamp[0] in (0, 1)),
            "endmember-file exactly when endmember-init is file": (self.endmember_init == "file")
            == (self.endmember_file is not None),
        }
        require("the model", self, rules)

    def resolve_auto(
        self, initial_data: Callable[[], Mapping[str, np.ndarray]], generator: torch.Generator
    ) -> tuple[UnmixModelConfig, str]:
        """With a number of endmembers, the scene's exposure and its light, and the evidence for them.

        Raises:
            SpectrumError: no pixel is neither dark nor saturated.
        """
        found, reasons = self, []
        if self.num_endmembers is None:
            first = initial_data()
            num_bands = len(first["typical"]) if "typical" in first else first["pixels"].shape[1]
            found = replace(found, num_endmembers=usual_num_endmembers(num_bands))
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

    @property
    def moving_lamp(self) -> Lamp | None:
        """The lamp that moves with the camera; None where light does not, or its place is not known."""
        if self.light != "camera" or self.lamp in ("auto", ()):
            return None
        return Lamp.of_numbers([float(x) for x in self.lamp])

    def checked_num_endmembers(self, num_bands: int) -> int:
        """K.

        Raises:
            ConfigError: more endmembers than bands.
        """
        count = self.num_endmembers
        if count is None:
            return usual_num_endmembers(num_bands)
        if count == "auto":
            raise ConfigError("num-endmembers is auto: call resolve_auto first")
        if count > num_bands:
            raise ConfigError(
                f"num-endmembers is {count} but the scene has {num_bands} bands; choose at most {num_bands}"
            )
        return count

    def num_dictionary_spectra(self, preset: AlphaPreset, num_endmembers: int) -> int:
        """Spectra of the specular dictionary."""
        if self.specular != "dictionary":
            return 0
        if self.num_specular_spectra == "auto":
            return 1 + num_endmembers if preset.specular_endmembers else 1
        return self.num_specular_spectra


def _resolved_losses(
    losses: LossConfig, initial_data: Callable[[], Mapping[str, np.ndarray]]
) -> tuple[LossConfig, list[str]]:
    """With what follows from the brightness and the noise of the scene, and the evidence for it."""
    reasons = []
    if losses.exposure == "auto":
        exposure = round(exposure_of(torch.from_numpy(initial_data()["pixels"])), 3)
        losses = replace(losses, exposure=exposure)
        if exposure > 1:
            reasons.append(
                f"the scene is dark: training compares spectra multiplied by {exposure:.3g} (exposure)"
            )
    if losses.relative == "auto":
        relative = round(float(initial_data().get("relative", 0.0)), 3)
        losses = replace(losses, relative=relative)
        if relative > 0:
            reasons.append(
                "part of the scene is much brighter than the rest: squared errors are divided by the "
                f"brightness to the power of {relative:.2g} (relative)"
            )
    if losses.band_weights == "auto":
        given = initial_data().get("band_weights", np.ones(1))
        weights = () if bool((given == 1).all()) else tuple(round(float(w), 6) for w in given)
        losses = replace(losses, band_weights=weights)
    return losses, reasons


def usual_num_endmembers(num_bands: int) -> int:
    """Endmembers of a scene whose user gives no number."""
    return min(_USUAL_ENDMEMBERS, num_bands)
