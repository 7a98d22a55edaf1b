"""What edits do to a run, measured on evaluation views; see editing.py."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor

    from unmix_plugin.editing.recipe import Recipe
    from unmix_plugin.engine.runs.load_run import LoadedModel
    from unmix_plugin.model import UnmixModel
    from unmix_plugin.scenes.scene import Scene
    from unmix_plugin.spectral.composition import Coefficients, Materials

PURE_SHARE, MAIN_SHARE, OPAQUE = 0.9, 0.75, 0.99
COLOURS = ("#8060a0", "#4080c0", "#b09040", "#707070")


@dataclass(frozen=True)
class View:
    """One evaluation view of the unedited run, and where it shows matter only."""

    index: int
    """Of the scene's frames."""
    coefficients: Coefficients
    is_opaque: Tensor


@dataclass(frozen=True)
class Subject:
    """The run that is edited."""

    model: UnmixModel
    scene: Scene
    views: list[View]
    seen: Coefficients
    endmember: int
    """The one whose material is separated best."""
    material: int
    iou: float

    @classmethod
    def of(cls, run: Path, folder: Path, device: str) -> Subject:
        """Render all evaluation views, and find the endmember to edit."""
        import torch

        from unmix_plugin.editing import sample_seen
        from unmix_plugin.engine.runs.load_run import load_model
        from unmix_plugin.model import UnmixModel
        from unmix_plugin.scenes.reading.loader import load_scene
        from unmix_plugin.scenes.scene import SceneOptions
        from unmix_plugin.spectral.composition import compose
        from unmix_plugin.spectral.segmentation import SegmentationTally

        loaded, scene = load_model(run, device), load_scene(folder, SceneOptions())
        model = loaded.model
        assert isinstance(model, UnmixModel)
        assert scene.material_names is not None
        tally = SegmentationTally(len(model.endmembers), len(scene.material_names))
        views = []
        for index in scene.eval_indices:
            coefficients = model.get_image_coefficients(scene.cameras[index])
            tally.add(
                compose("segmentation", coefficients, model.materials), torch.tensor(scene.labels(index))
            )
            alpha = scene.alpha(index)
            assert alpha is not None
            views.append(View(index, coefficients, torch.tensor(alpha > OPAQUE, device=model.device)))
        scores = tally.scores()
        endmember, material = max(scores.matching.items(), key=lambda pair: scores.iou[pair[1]])
        seen = sample_seen(model, loaded.scene.train_cameras)
        return cls(model, scene, views, seen, endmember, material, scores.iou[material])

    def materials(self, recipe: Recipe) -> Materials:
        """The materials after a recipe that leaves the geometry as it is."""
        from unmix_plugin.editing import changes_geometry, edit_model

        assert not changes_geometry(recipe)
        return edit_model(self.model, recipe, self.seen).materials

    def pixels(self, materials: Materials, output: str, least_share: float) -> Tensor:
        """What the opaque pixels show of which the endmember has at least a share: rows."""
        import torch

        from unmix_plugin.spectral.composition import compose

        rows = []
        for view in self.views:
            shares = view.coefficients.abundances[..., self.endmember] / view.coefficients.accumulation.clamp(
                min=1e-6
            )
            rows.append(
                compose(output, view.coefficients, materials)[view.is_opaque & (shares >= least_share)]
            )
        return torch.cat(rows)


def measure_swap(subject: Subject) -> dict[str, float]:
    """Greatest difference of spectra after one swap, and after two."""
    from unmix_plugin.editing import edit_model, recipe_from_yaml

    camera = subject.scene.cameras[subject.views[0].index]
    original, once, twice = (
        edit_model(subject.model, recipe_from_yaml(f"edits: {edits}")).get_outputs_for_camera(
            camera, ["spectral"]
        )
        for edits in ("[]", "[{swap: [0, 1]}]", "[{swap: [0, 1]}, {swap: [1, 0]}]")
    )
    differences = [float((other["spectral"] - original["spectral"]).abs().max()) for other in (once, twice)]
    return {"once": differences[0], "twice": differences[1]}


def measure_replacing(subject: Subject, folder: Path) -> dict[str, Any]:
    """Mean spectral angle of the endmember's pixels to each material that it is replaced by."""
    import torch

    from unmix_plugin.editing import FileSpectrum, Recipe, Replace
    from unmix_plugin.spectral.metrics import spectral_angle

    scene = subject.scene
    assert scene.material_names is not None
    assert scene.endmembers is not None
    assert scene.illuminant is not None
    angles, before, count = {}, {}, 0
    for material, name in enumerate(scene.material_names):
        if material == subject.material:
            continue
        target = torch.tensor(scene.endmembers[material] * scene.illuminant, device=subject.model.device)
        recipe = Recipe((Replace(subject.endmember, FileSpectrum(folder / "endmembers.csv", name)),))
        for found, materials in ((angles, subject.materials(recipe)), (before, subject.model.materials)):
            pixels = subject.pixels(materials, "spectral", PURE_SHARE).double().detach()
            found[name] = float(spectral_angle(pixels, target.expand_as(pixels)).mean())
            count = len(pixels)
    return {
        "material": scene.material_names[subject.material],
        "intersection over union": subject.iou,
        "pixels": count,
        "angle_rad": angles,
        "angle_before_rad": before,
    }


def measure_retinting(subject: Subject) -> dict[str, Any]:
    """CIEDE2000 of the endmember's pixels to each colour asked for, and the same of the spectrum on request."""
    from unmix_plugin.editing import recipe_from_yaml

    found: dict[str, Any] = {}
    for colour in COLOURS:
        edit = f"endmember: {subject.endmember}, colour: '{colour}'"
        in_picture = subject.materials(recipe_from_yaml(f"edits: [{{retint: {{{edit}}}}}]"))
        as_spectrum = subject.materials(recipe_from_yaml(f"edits: [{{retint: {{{edit}, match: spectrum}}}}]"))
        pixels = subject.pixels(in_picture, "rgb", MAIN_SHARE)
        every = subject.pixels(in_picture, "rgb", 0.5)
        own = own_srgb(as_spectrum, subject.endmember)
        found[colour] = {
            "pixels": len(pixels),
            "pictures": colour_error(pixels.mean(dim=0), colour),
            "pictures, share of half": colour_error(every.mean(dim=0), colour),
            "spectrum, match: spectrum": colour_error(own, colour),
        }
    return found


def measure_relighting(run: Path, folder: Path, device: str) -> dict[str, float]:
    """CIEDE2000 of a run of the built-in scene in illuminant A to the scene made in A."""
    import numpy as np
    import torch

    from unmix_plugin.editing import Light, relight
    from unmix_plugin.engine.runs.load_run import load_model
    from unmix_plugin.model import UnmixModel
    from unmix_plugin.spectral.metrics import psnr

    loaded = load_model(run, device)
    model = loaded.model
    assert isinstance(model, UnmixModel)
    day, lamp = (built_in_scene(loaded, folder / name, name) for name in ("D50", "A"))
    assert lamp.illuminant is not None
    relit = relight(model, Light("A"))
    # The generator scales every lamp to a greatest power of 1, edits keep white as bright as it was.
    exposure = float(np.mean(np.array(relit.metadata["illuminant"]) / lamp.illuminant))
    factors = torch.tensor(relit.metadata["illuminant"]) / torch.tensor(model.metadata["illuminant"])
    errors: dict[str, list[Any]] = {"relit": [], "not relit": [], "as learnt": [], "measured and relit": []}
    decibels = []
    for index in lamp.eval_indices:
        alpha = lamp.alpha(index)
        assert alpha is not None
        opaque = torch.tensor(alpha > OPAQUE)
        in_day, in_lamp = (torch.from_numpy(scene.cube(index)) for scene in (day, lamp))
        lit, unlit = (
            one.get_outputs_for_camera(lamp.cameras[index], ["spectral"])["spectral"].cpu()
            for one in (relit, model)
        )
        decibels.append(psnr(unlit, in_day))
        true = exposure * in_lamp
        pairs = ((lit, true), (unlit, true), (unlit, in_day), (in_day * factors, true))
        for name, (shown, wanted) in zip(errors, pairs, strict=True):
            errors[name].append(view_colour_error(shown[opaque], wanted[opaque], model))
    means = {name: float(np.concatenate(values).mean()) for name, values in errors.items()}
    return means | {"exposure": exposure, "psnr": float(np.mean(decibels))}


def built_in_scene(run: LoadedModel, folder: Path, illuminant: str) -> Scene:
    """The scene that a run of it learnt, made in a light."""
    from unmix_plugin.scenes.demo.scene import make_demo_scene
    from unmix_plugin.scenes.reading.loader import load_scene
    from unmix_plugin.scenes.scene import SceneOptions

    cameras = run.scene.train_cameras
    views = len(cameras) + len(run.scene.eval_cameras)
    make_demo_scene(
        folder, cameras.width, len(run.scene.metadata["wavelengths_nm"]), views, illuminant=illuminant
    )
    return load_scene(folder, SceneOptions())


def view_colour_error(shown: Tensor, true: Tensor, model: UnmixModel) -> Any:
    """CIEDE2000 of each pixel, as sRGB."""
    from unmix_plugin.spectral.colour.difference import ciede2000, srgb_to_lab

    first, second = (srgb_to_lab(srgb_of(spectra, model.materials).numpy()) for spectra in (shown, true))
    return ciede2000(first, second)


def srgb_of(spectra: Tensor, materials: Materials) -> Tensor:
    """sRGB colours of spectra."""
    import torch

    from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix

    linear = spectra.detach().cpu().double().clamp(min=0) @ rgb_matrix(materials.bands, torch.float64)
    return linear_to_srgb(linear.clamp(0, 1))


def own_srgb(materials: Materials, endmember: int) -> Tensor:
    """sRGB of an endmember's spectrum."""
    return srgb_of(materials.endmembers[endmember], materials)


def colour_error(srgb: Tensor, asked: str) -> float:
    """CIEDE2000 of a colour to `#rrggbb`."""
    import numpy as np

    from unmix_plugin.spectral.colour.difference import ciede2000, srgb_to_lab

    wanted = np.array([int(asked[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    return float(ciede2000(srgb_to_lab(srgb.detach().cpu().double().numpy()), srgb_to_lab(wanted)))
