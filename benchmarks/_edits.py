"""What edits do to a run, measured on evaluation views; see editing.py."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor

    from unmix_plugin.editing.recipe import Recipe
    from unmix_plugin.scenes.scene import Scene
    from unmix_plugin.spectral.bands import Bands
    from unmix_plugin.trained.open_run import LoadedRun
    from unmix_plugin.trained.trained_scene import MaterialView, TrainedScene

PURE_SHARE, MAIN_SHARE, OPAQUE = 0.9, 0.75, 0.99
COLOURS = ("#8060a0", "#4080c0", "#b09040", "#707070")


@dataclass(frozen=True)
class View:
    """One evaluation view of the unedited run, and which of its pixels are opaque."""

    rendered: MaterialView
    is_opaque: Tensor

    def of(self, scene: TrainedScene) -> MaterialView:
        """The same view with other materials on the same shapes."""
        return replace(self.rendered, scene=scene)


@dataclass(frozen=True)
class Subject:
    """The run that is edited."""

    trained: TrainedScene
    scene: Scene
    """What it was trained on."""
    views: list[View]
    endmember: int
    """The one whose material is separated best."""
    material: int
    iou: float

    @classmethod
    def of(cls, run: Path, folder: Path, device: str) -> Subject:
        """Render all evaluation views, and find the endmember to edit."""
        import torch

        from unmix_plugin.scenes.reading.loader import load_scene
        from unmix_plugin.settings import SceneOptions
        from unmix_plugin.spectral.segmentation import SegmentationTally
        from unmix_plugin.trained.open_run import open_run

        trained, scene = open_run(run, device), load_scene(folder, SceneOptions())
        assert scene.material_names is not None
        tally = SegmentationTally(len(trained.materials.names), len(scene.material_names))
        views = []
        for index in scene.eval_indices:
            view = trained.look(scene.cameras[index])
            tally.add(view["segmentation"], torch.tensor(scene.labels(index)))
            alpha = scene.alpha(index)
            assert alpha is not None
            views.append(View(view, torch.tensor(alpha > OPAQUE, device=trained.device)))
        scores = tally.scores()
        endmember, material = max(scores.matching.items(), key=lambda pair: scores.iou[pair[1]])
        return cls(trained, scene, views, endmember, material, scores.iou[material])

    def edited(self, recipe: Recipe) -> TrainedScene:
        """The scene after a recipe that leaves the geometry as it is."""
        from unmix_plugin.editing import changes_geometry, edit_scene

        assert not changes_geometry(recipe)
        return edit_scene(self.trained, recipe)

    def pixels(self, edited: TrainedScene, output: str, least_share: float) -> Tensor:
        """What the opaque pixels show of which the endmember has at least a share: rows."""
        import torch

        rows = []
        for view in self.views:
            found = view.rendered.coefficients
            shares = found.abundances[..., self.endmember] / found.accumulation.clamp(min=1e-6)
            rows.append(view.of(edited)[output][view.is_opaque & (shares >= least_share)])
        return torch.cat(rows)


def measure_swap(subject: Subject) -> dict[str, float]:
    """Greatest difference of spectra after one swap, and after two."""
    from unmix_plugin.editing import edit_scene, recipe_from_yaml

    camera = subject.views[0].rendered.camera
    original, once, twice = (
        edit_scene(subject.trained, recipe_from_yaml(f"edits: {edits}")).render(camera, ["spectral"])
        for edits in ("[]", "[{swap: [0, 1]}]", "[{swap: [0, 1]}, {swap: [1, 0]}]")
    )
    differences = [float((other["spectral"] - original["spectral"]).abs().max()) for other in (once, twice)]
    return {"once": differences[0], "twice": differences[1]}


def measure_replacing(subject: Subject, folder: Path) -> dict[str, Any]:
    """Mean spectral angle of the endmember's pixels to each material that it is replaced by."""
    import torch

    from unmix_plugin.editing import Recipe, Replace
    from unmix_plugin.spectral.metrics import spectral_angle

    scene = subject.scene
    assert scene.material_names is not None
    assert scene.endmembers is not None
    assert scene.illuminant is not None
    angles, before, count = {}, {}, 0
    for material, name in enumerate(scene.material_names):
        if material == subject.material:
            continue
        target = torch.tensor(scene.endmembers[material] * scene.illuminant, device=subject.trained.device)
        recipe = Recipe((Replace(subject.endmember, None, folder / "endmembers.csv", name),))
        for found, shown in ((angles, subject.edited(recipe)), (before, subject.trained)):
            pixels = subject.pixels(shown, "spectral", PURE_SHARE).double()
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
        in_picture = subject.edited(recipe_from_yaml(f"edits: [{{retint: {{{edit}}}}}]"))
        as_spectrum = subject.edited(recipe_from_yaml(f"edits: [{{retint: {{{edit}, match: spectrum}}}}]"))
        pixels = subject.pixels(in_picture, "rgb", MAIN_SHARE)
        every = subject.pixels(in_picture, "rgb", 0.5)
        own = srgb_of(as_spectrum.materials.endmembers[subject.endmember], as_spectrum.bands)
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

    from unmix_plugin.editing import Light, Recipe, edit_scene
    from unmix_plugin.spectral.metrics import psnr
    from unmix_plugin.trained.open_run import load_run

    loaded = load_run(run, device)
    trained = loaded.materials_scene
    day, lamp = (built_in_scene(loaded, folder / name, name) for name in ("D50", "A"))
    assert lamp.illuminant is not None
    relit = edit_scene(trained, Recipe(illuminant=Light("A")))
    assert trained.light is not None
    assert relit.light is not None
    # The generator scales every lamp to a greatest power of 1, edits keep white as bright as it was.
    exposure = float(np.mean(relit.light.cpu().numpy() / lamp.illuminant))
    factors = (relit.light / trained.light).cpu()
    errors: dict[str, list[Any]] = {"relit": [], "not relit": [], "as learnt": [], "measured and relit": []}
    decibels = []
    for index in lamp.eval_indices:
        alpha = lamp.alpha(index)
        assert alpha is not None
        opaque = torch.tensor(alpha > OPAQUE)
        in_day, in_lamp = (torch.from_numpy(scene.cube(index)) for scene in (day, lamp))
        lit, unlit = (
            one.render(lamp.cameras[index], ["spectral"])["spectral"].cpu() for one in (relit, trained)
        )
        decibels.append(psnr(unlit, in_day))
        true = exposure * in_lamp
        pairs = ((lit, true), (unlit, true), (unlit, in_day), (in_day * factors, true))
        for name, (shown, wanted) in zip(errors, pairs, strict=True):
            errors[name].append(view_colour_error(shown[opaque], wanted[opaque], trained.bands))
    means = {name: float(np.concatenate(values).mean()) for name, values in errors.items()}
    return means | {"exposure": exposure, "psnr": float(np.mean(decibels))}


def built_in_scene(run: LoadedRun, folder: Path, illuminant: str) -> Scene:
    """The scene that a run of it learnt, made in a light."""
    from unmix_plugin.scenes.demo.scene import make_demo_scene
    from unmix_plugin.scenes.reading.loader import load_scene
    from unmix_plugin.settings import SceneOptions

    cameras = run.record.train_cameras
    views = len(cameras) + len(run.record.eval_cameras)
    num_bands = len(run.record.metadata["wavelengths_nm"])
    make_demo_scene(folder, cameras.width, num_bands, views, illuminant=illuminant)
    return load_scene(folder, SceneOptions())


def view_colour_error(shown: Tensor, true: Tensor, bands: Bands) -> Any:
    """CIEDE2000 of each pixel, as sRGB."""
    from unmix_plugin.spectral.colour.difference import ciede2000, srgb_to_lab

    first, second = (srgb_to_lab(srgb_of(spectra, bands).numpy()) for spectra in (shown, true))
    return ciede2000(first, second)


def srgb_of(spectra: Tensor, bands: Bands) -> Tensor:
    """sRGB colours of spectra."""
    import torch

    from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix

    linear = spectra.detach().cpu().double().clamp(min=0) @ rgb_matrix(bands, torch.float64)
    return linear_to_srgb(linear.clamp(0, 1))


def colour_error(srgb: Tensor, asked: str) -> float:
    """CIEDE2000 of a colour to `#rrggbb`."""
    import numpy as np

    from unmix_plugin.spectral.colour.difference import ciede2000, srgb_to_lab

    wanted = np.array([int(asked[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    return float(ciede2000(srgb_to_lab(srgb.detach().cpu().double().numpy()), srgb_to_lab(wanted)))
