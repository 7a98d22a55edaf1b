"""What each benchmark measures: when one of these files of `unmix_plugin/` changes, its results may be old.

`make results-check` compares them with the revisions that results name.
"""

from pathlib import Path

DEPENDS_ON: dict[str, tuple[str, ...]] = {
    "asset": ("neumatex", "trained", "rendering", "field.py", "model.py"),
    "backdrops": ("captures", "scenes"),
    "band_cost": ("rendering", "operators", "model.py", "field.py"),
    "captures": ("captures",),
    "captures_training": ("captures", "light", "losses", "rendering", "model.py", "field.py"),
    "changes": ("comparing",),
    "confidence": ("trained", "spectral", "model.py", "field.py"),
    "cost512": ("operators", "rendering", "engine"),
    "decisions": ("scenes", "captures/match_checks.py", "datamanager.py"),
    "disturbed": ("captures", "scenes"),
    "editing": ("editing", "trained"),
    "equal_steps": ("rendering", "losses", "operators", "model.py", "field.py", "datamanager.py"),
    "export_speed": ("products", "formats", "trained"),
    "few_views": ("rendering", "losses", "model.py", "field.py"),
    "field_first": ("losses", "spectral", "model.py", "field.py"),
    "flight": ("captures/layouts", "scenes", "rendering", "products/render"),
    "found_poses": ("captures/poses",),
    "fresh_clone": ("commands",),
    "fuzz": ("captures", "scenes", "formats", "engine/runs", "editing"),
    "fuzz_commands": ("commands", "captures", "engine/runs"),
    "fuzz_guided": ("captures/readers", "formats"),
    "gpu": ("operators", "rendering", "engine", "viewer"),
    "intervals": ("trained", "spectral", "losses/abundance_guide.py"),
    "kill": ("engine",),
    "landscapes": ("spectral/unmixing",),
    "lenses": ("captures/poses", "captures/writing"),
    "limits": ("limits.py", "captures/readers", "scenes", "engine/runs"),
    "measures": ("products", "trained", "editing"),
    "memory": ("scenes", "datamanager.py", "engine"),
    "neumatex": ("neumatex",),
    "neumatex_decoder": ("neumatex/fit", "neumatex/weights"),
    "neumatex_prior": ("neumatex/prior", "neumatex/weights"),
    "neumatex_spectral": ("neumatex",),
    "neumatex_tracer": ("neumatex/tracing",),
    "operators": ("operators",),
    "other_viewers": ("formats", "products"),
    "page": ("products/page",),
    "poses": ("poses",),
    "processes": ("engine", "operators"),
    "processing": ("captures",),
    "quality": (
        "rendering",
        "losses",
        "operators",
        "spectral",
        "light",
        "model.py",
        "field.py",
        "datamanager.py",
    ),
    "resume": ("engine",),
    "rig": ("sensors", "light", "model.py"),
    "splats": ("products/splat_fit.py", "products/splats.py", "operators/splatting.py"),
    "spoilt_views": ("captures",),
    "step_profile": ("operators", "rendering", "engine", "losses", "model.py", "field.py"),
    "store": ("scenes", "datamanager.py"),
    "subspace": ("spectral",),
    "unexplained": ("trained", "spectral/unmixing"),
    "unmixing": ("spectral", "losses", "model.py", "field.py"),
    "unmixing_2d": ("spectral/unmixing",),
    "viewer": ("viewer", "trained", "rendering"),
    "world": ("rendering", "scenes", "model.py"),
    "wrong_results": ("captures", "scenes"),
}
"""By benchmark: files and folders in `unmix_plugin/`."""


def benchmark_of(result: str) -> str:
    """The benchmark that wrote a result, whose variant stands behind a hyphen.

    >>> benchmark_of("captures_training-basil-defaults")
    'captures_training'
    """
    return result.partition("-")[0]


def measured_by(result: str) -> list[Path]:
    """What a result depends on, from the root of the repository; the benchmark itself first."""
    name = benchmark_of(result)
    return [Path(f"benchmarks/{name}.py"), *(Path("unmix_plugin", part) for part in DEPENDS_ON[name])]
