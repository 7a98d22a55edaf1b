"""Settings with which a training of a few steps is fast."""

SMALL = [
    "--pipeline.datamanager.train-num-rays-per-batch=256",
    "--pipeline.model.plane-resolution=16",
    "--pipeline.model.eval-samples=16",
    "--pipeline.model.samples=4",
    "--device=cpu",
]
