"""The generic engine: configs, registry, cameras, base classes, trainer, run folders; it knows no spectrum.

A method is a `MethodSpecification` (registry) around a `TrainerConfig` (configs) that names subclasses of
`DataManager` (data_manager) and `Model` (model); `Trainer` (trainer) trains it, `load_model` (load_run) brings it back.
"""
