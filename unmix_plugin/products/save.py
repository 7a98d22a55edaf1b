"""One output of one rendered view as a file, for scripts and notebooks; `render/` writes it as `unmix-render` does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from unmix_plugin.errors import ConfigError
from unmix_plugin.products.render.files import Rows, choose_formats, is_painted, still
from unmix_plugin.products.render.job import setting_for, take_survey
from unmix_plugin.trained.mixture_view import picture_values, values_of
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.trained.trained_scene import MaterialView

_FORMATS = {".npy": "npy", ".png": "png", ".exr": "exr", ".hdr": "envi"}


def save(view: MaterialView, name: str, path: str | Path, *, label: str = "") -> Path:
    """Write an output of a view, in place of an earlier one of ours; files of others are never replaced.

    Args:
        view: As `TrainedScene.look` gives it.
        name: Of the output, such as `rgb`, `abundances` or `band:650nm`.
        path: File to write. Its suffix says how: .npy (the numbers), .png (a picture), .exr (OpenEXR), or .hdr (ENVI: a
            header, and the data beside it as .img).
        label: Of what the numbers are, such as the name of the view: .exr and .hdr say it. Empty: the output's name.
    Returns:
        The path.
    Raises:
        ConfigError: an unknown output or suffix, or an output that can't be written that way.
        SpectrumError: the bands don't cover what the output needs.
        RunError: the disk is full or refuses, or a file is there that we did not write, or that was changed since.
    """
    path = Path(path)
    if path.suffix not in _FORMATS:
        known = ", ".join(_FORMATS)
        raise ConfigError(f"{path}: the suffix {path.suffix!r} says no format; give one of {known}")
    scene, camera = view.scene, view.camera
    (formatted,) = choose_formats([name], [_FORMATS[path.suffix]], scene, is_path=False)
    outputs = [formatted.output]
    survey = take_survey(scene, [RunView(path.stem, camera)], outputs if path.suffix == ".png" else [])
    setting = replace(setting_for(scene, camera, outputs, survey, path.parent), label=label)
    own = survey.outputs.get(name, formatted.output)
    values = {} if is_painted(formatted) else {name: values_of(view, own).cpu().numpy()}
    painted = {name: picture_values(view, own)} if is_painted(formatted) else {}
    opacity, coverage = (part.cpu().numpy() for part in (view.opacity, view.coverage))
    with still(path, formatted, setting) as add:
        add(Rows(0, values, painted, opacity, coverage))
    return path
