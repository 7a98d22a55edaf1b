"""The whole training loop, for whoever wants to change the method: `python examples/simple_trainer.py [SCENE [STEPS]]`.

Trains unmix-nerf on a scene (the built-in one by default) as `unmix-train` does, without what a run needs besides:
no run folder, no resuming, no average of the parameters, no guard against steps that are not finite. A hundred steps on
the built-in scene reach 23 dB.
"""

import sys
from pathlib import Path

import torch

from unmix_plugin.engine import TrainerConfig, TrainingCallbackLocation, find_method


def train(config: TrainerConfig, data: Path, num_steps: int) -> dict[str, float]:
    """Train with the settings of a method, and return the metrics of the evaluation views."""
    pipeline = config.pipeline.setup(data=data, device=torch.device("cpu"), seed=config.seed)
    pipeline.initialise()  # first endmembers, from the pixels
    model, rays = pipeline.model, pipeline.datamanager
    groups = {name: group for name, group in model.get_param_groups().items() if group}
    adam = torch.optim.Adam([{"params": group, "name": name} for name, group in groups.items()], eps=1e-15)
    callbacks = [*rays.get_training_callbacks(), *model.get_training_callbacks()]
    for step in range(num_steps):
        progress = step / num_steps
        pipeline.seed_step(step)
        for callback in callbacks:
            if callback.where is TrainingCallbackLocation.BEFORE_TRAIN_ITERATION:
                callback.func(step, progress)
        with torch.no_grad():
            model.between_steps(step, progress, rays)
        for group in adam.param_groups:  # learning rates fall by equal factors
            setting = config.optimizers[group["name"]]
            group.update(lr=setting.lr * setting.final_factor**progress, weight_decay=setting.weight_decay)
        bundle, batch = rays.next_train(step)  # rays, and what was measured along them
        outputs, losses, _ = model.get_train_loss_dict(bundle, batch)
        loss = torch.stack(list(losses.values())).sum()
        adam.zero_grad()
        loss.backward()
        with torch.no_grad():
            model.update(outputs)  # what is learnt without gradients
        adam.step()
        for callback in callbacks:
            if callback.where is TrainingCallbackLocation.AFTER_TRAIN_ITERATION:
                callback.func(step, progress)
        wanted = model.next_num_rays(model.num_samples(outputs), len(bundle))
        rays.set_train_rays_per_batch(wanted or len(bundle))
        if step % 100 == 0:
            print(f"step {step}: loss {loss.item():.4f}")
    return pipeline.get_average_eval_image_metrics_and_images()[0]


if __name__ == "__main__":
    scene, steps = [*sys.argv[1:], *("demo", "1000")[len(sys.argv) - 1 :]]
    metrics = train(find_method("unmix-nerf").config, Path(scene), int(steps))
    print(", ".join(f"{name} {value:.4g}" for name, value in metrics.items()))
